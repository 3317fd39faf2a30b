"""The landing mission: state machine, reference trajectories, descent, touchdown detection,
energy and estimator health. Decides where to fly; the sites come from ``landing.selection``."""
