"""Objects that stand on the ground, built as MJCF geoms with meshes and textures."""
