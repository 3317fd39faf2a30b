"""`touchdown calibrate`: rendered chessboard views, calibration errors, figures. The calibration
itself is in `estimator.calibration`."""
