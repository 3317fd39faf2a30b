"""Filter, propagation, map of planes and keyframes that estimators share."""
