"""Renderings and checks of scenes."""
