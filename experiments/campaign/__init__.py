"""Many flights: plan, executors, directory, result table."""
