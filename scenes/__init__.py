"""Places to land in: MJCF scenes, their textures and their ground truth."""
