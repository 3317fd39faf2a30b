"""Camera intrinsics and LIDAR-camera extrinsics from a chessboard (Zou, Sun and Kong 2024, section
3.2); ``calibrate`` is the entry point."""
