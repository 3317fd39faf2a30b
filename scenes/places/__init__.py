"""One folder for each scene of the project: its MJCF and its generator."""
