"""Scan patterns and data-sheet figures of LIDAR presets, one module for each kind of optics."""
