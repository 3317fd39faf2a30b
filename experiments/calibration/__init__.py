"""`touchdown calibrate`: camera intrinsics and LIDAR-camera extrinsics from a chessboard (Zou, Sun
and Kong 2024, section 3.2), over rendered views; calibration errors and figures. ``calibrate`` is
the calibration itself."""
