"""The landing on a deck that moves."""
