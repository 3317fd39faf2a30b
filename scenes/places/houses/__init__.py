"""A settlement: streets, houses with gardens, a green with a playground."""
