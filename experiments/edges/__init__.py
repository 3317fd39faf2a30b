"""`touchdown edges`: training data, training and scores of the edge detector."""
