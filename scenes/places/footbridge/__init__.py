"""`footbridge`: a footbridge over a stream, or over a road in a cutting, between lawns."""
