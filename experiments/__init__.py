"""Wiring, the one main loop, referee, recordings and the command line."""

import os

# Matrices of an estimator are small, and sums over two threads differ in their last bits from sums
# over one: a flight by itself is to be the flight of a campaign. Read when NumPy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
