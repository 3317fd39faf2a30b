"""Surfaces of MuJoCo geoms as triangles, and rays cast at them; shared by the LIDAR and the ground
truth of scenes. It depends on nothing of ours but `sim.frames`."""
