"""Wiring, the one main loop, referee, recordings and the command line."""
