"""Landing site selection: costmaps, clustering, risk."""
