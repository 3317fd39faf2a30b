"""`touchdown scenes`: renderings, exports and checks of scenes, and the configured sensors at given
poses over a scene."""
