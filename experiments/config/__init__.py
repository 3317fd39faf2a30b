"""Configuration: schema, loading, ranges, checks across keys. Imports no simulator."""
