"""Cottages with courtyards along a village lane on a sloped meadow."""
