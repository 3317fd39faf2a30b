"""The configuration: schema, loading, checks across keys. Imports no simulator."""
