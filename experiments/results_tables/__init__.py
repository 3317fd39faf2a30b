"""``touchdown results``: the flights behind README and the results pages, and their tables."""
