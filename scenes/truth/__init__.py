"""Ground truth of a compiled scene by ray casting: height, slope, class and safety."""
