"""The coloured elevation map, one mapper for every estimator."""
