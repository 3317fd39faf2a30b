"""Recordings of others as observations of our estimators."""
