"""What estimators share: the inertial core (error-state filter, propagation, arrival), scan screening
and deskewing, plane map, keyframes, landmark depths."""
