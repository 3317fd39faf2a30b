"""One flight: wiring, loop, referee, metrics, result; replay of a sensor log; compiled kernels."""
