"""`touchdown bench`: speed and accuracy beside peers and bounds."""
