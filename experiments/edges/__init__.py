"""`touchdown edges`: scores and a figure of the structured edge detector of `zou2024`."""
