"""A swimming bath: pools, decks, sunshades, and a sports field beside them."""
