"""Parts that several estimators share: error-state filter, IMU propagation, scan screening and
deskewing, plane map, keyframes, landmark depths."""
