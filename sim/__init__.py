"""The simulated world: physics, wind, clock and sensors."""
