"""`touchdown bench touchdown`: what ground the vehicle stands on after a touchdown."""
