"""The ray-cast LIDAR: sensor, ray casting, link budget, noise, echoes of fog and rain; scan
patterns in `patterns`."""
