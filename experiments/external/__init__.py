"""External estimators: loading, wrapping, conformance checks."""
