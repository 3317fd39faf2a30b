"""Open water around a raft, a pontoon or an islet: the only ground to land on."""
