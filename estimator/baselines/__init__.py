"""Positioning as it is done without a LIDAR: what the others are compared with."""
