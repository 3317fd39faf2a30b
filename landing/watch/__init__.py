"""The watch: what stands, moves and has appeared where the vehicle is about to touch down, seen in
the scans of the last seconds. Names nothing of the mission."""
