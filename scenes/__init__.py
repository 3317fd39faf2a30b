"""Scenes to land in: MJCF models, their generators and textures, and their ground truth.

Other folders use `scenes.api`; `compose.load_scene` builds a scene by name or from a file."""
