"""`touchdown dataset`, `train`, `evaluate`, `quantize`, `classify`: the ground classifier."""
