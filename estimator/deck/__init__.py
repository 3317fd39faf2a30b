"""A deck that moves, measured relative to the vehicle."""
