"""Vectors of three numbers for kernels: tuples, which stay in registers."""

from numba import njit

from touchdown.sim.typing import Array

Vector = tuple[float, float, float]
UNIT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
ZERO = (0.0, 0.0, 0.0)


@njit(cache=True, error_model="numpy")
def xyz(values: Array) -> Vector:
    """The first three numbers of an array."""
    return values[0], values[1], values[2]


@njit(cache=True, error_model="numpy")
def along(start: Vector, length: float, direction: Vector) -> Vector:
    """``start + length * direction``"""
    return (
        start[0] + length * direction[0],
        start[1] + length * direction[1],
        start[2] + length * direction[2],
    )


@njit(cache=True, error_model="numpy")
def dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, error_model="numpy")
def cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True, error_model="numpy")
def turned(r: Array, v: Vector) -> Vector:
    """``r @ v``"""
    return (
        r[0, 0] * v[0] + r[0, 1] * v[1] + r[0, 2] * v[2],
        r[1, 0] * v[0] + r[1, 1] * v[1] + r[1, 2] * v[2],
        r[2, 0] * v[0] + r[2, 1] * v[1] + r[2, 2] * v[2],
    )


@njit(cache=True, error_model="numpy")
def turned_back(r: Array, v: Vector) -> Vector:
    """``r.T @ v``"""
    return (
        r[0, 0] * v[0] + r[1, 0] * v[1] + r[2, 0] * v[2],
        r[0, 1] * v[0] + r[1, 1] * v[1] + r[2, 1] * v[2],
        r[0, 2] * v[0] + r[1, 2] * v[1] + r[2, 2] * v[2],
    )
