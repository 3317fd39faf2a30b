"""Ground truth from the compiled model, by ray casting."""
