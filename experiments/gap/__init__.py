"""`touchdown gap`: how far the simulated world is from recordings of the real one."""
