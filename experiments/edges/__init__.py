"""`touchdown edges`: scores and figures of the structured edge detector of
`estimator.zou2024.structured_edges`."""
