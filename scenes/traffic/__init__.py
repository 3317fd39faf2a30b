"""People, animals and vehicles that move through a scene."""
