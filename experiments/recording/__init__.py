"""Files that a flight writes: trajectories, the Rerun recording, map and costmap."""
