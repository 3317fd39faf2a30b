"""Flights in this folder share their scenes."""

from support.scene_cache import scenes_built_once

__all__ = ["scenes_built_once"]
