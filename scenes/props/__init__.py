"""Things that stand on the ground, built as MJCF geoms."""
