"""Tightly coupled LIDAR-inertial-visual odometry."""
