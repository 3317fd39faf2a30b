"""`touchdown regress`: baseline, comparison, verdict."""
