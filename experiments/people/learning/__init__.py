"""Training of the network that finds people; loads torch."""
