"""Map images, axes and contact sheets. Knows nothing of flights."""
