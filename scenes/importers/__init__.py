"""Scenes from files: MJCF and digital elevation models."""
