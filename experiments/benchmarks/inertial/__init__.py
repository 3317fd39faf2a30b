"""LIDAR-inertial odometry of others on logged scans and IMU samples."""
