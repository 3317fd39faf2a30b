"""A lake with beach, reeds, jetty and boats between meadows."""
