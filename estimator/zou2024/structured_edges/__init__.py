"""The structured edge detector: random forest, its file, the image of edge energy."""
