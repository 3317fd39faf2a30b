"""The landing mission: state machine, choice of a site, reference trajectories, descent, touchdown
detection, energy and estimator health. Decides where to fly; candidate sites come from
``landing.selection``, the class of their ground from ``landing.classification``."""
