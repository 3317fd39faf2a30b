"""Positioning without a LIDAR, as a reference: GPS, optical flow, hybrid flow, stereo."""
