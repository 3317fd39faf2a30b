"""Two crossing roads between houses, gardens and rugged lawns."""
