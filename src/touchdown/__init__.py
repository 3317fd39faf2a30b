"""Touchdown: a closed-loop simulation testbed for landing a quadrotor without GPS."""

import os

# Sums over two threads differ in their last bits from sums over one. NumPy reads this when it is
# loaded, so it is set before.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
