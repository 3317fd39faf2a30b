"""Scenes from files of users: MJCF models and digital elevation models (GeoTIFF)."""
