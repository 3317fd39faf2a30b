"""Training and what else needs torch."""
