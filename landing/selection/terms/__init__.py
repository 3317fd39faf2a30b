"""The terms of a score, one module each: a function ``term`` of ``inputs.Inputs`` that returns the
layer of the map which is added to the score."""
