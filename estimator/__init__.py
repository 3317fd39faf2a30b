"""Position estimators and the mapper that serves all of them."""
