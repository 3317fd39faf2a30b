"""PX4's SITL as the controller of a flight: the world is its simulator over MAVLink."""
