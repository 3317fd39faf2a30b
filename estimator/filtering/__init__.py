"""What estimators share: the inertial core (error-state filter, propagation, arrival), scans,
screened and deskewed, plane map, keyframes, landmark depths."""
