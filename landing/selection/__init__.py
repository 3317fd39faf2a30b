"""Landing site selection on an elevation map: costmaps of the paper, clustering, geometric checks
and the probability of a safe touchdown. Arrays in, candidates out; nothing here flies."""
