"""The mapper: a coloured elevation map, the same for every estimator."""
