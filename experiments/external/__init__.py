"""Estimators of users: loading, wrapping, conformance checks."""
