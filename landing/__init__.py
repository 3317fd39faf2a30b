"""Choosing a landing site and planning the flight to it."""
