"""Fresh snow over gentle relief, with drifts, tracks, a hut and a frozen pond."""
