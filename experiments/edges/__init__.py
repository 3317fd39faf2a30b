"""`touchdown edges`: training data, training, scores and figures of the structured edge detector.
The detector itself is in `estimator.zou2024.structured_edges`."""
