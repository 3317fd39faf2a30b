"""`touchdown bench`: speed and accuracy, compared with reference implementations and bounds."""
