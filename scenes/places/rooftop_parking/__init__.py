"""`rooftop_parking`: a flat roof used as a car park, above the streets of a town."""
