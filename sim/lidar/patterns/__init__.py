"""Scan patterns and data-sheet figures of LIDAR presets."""
