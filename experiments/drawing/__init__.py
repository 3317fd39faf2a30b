"""Map images, axes and contact sheets, independent of flights."""
