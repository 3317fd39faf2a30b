"""`touchdown edges`: training data, training, scores and figures of the structured edge detector.
The detector itself is in `estimator.paper.structured_edges`."""
