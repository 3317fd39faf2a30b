"""Smooth random fields over the plane and in space that are functions of the place alone.

Value noise: the nodes of a square or cubic lattice have hashed values, evenly distributed, and
between them a smoothstep interpolates; the sum is scaled to unit variance at every place. Several
lattices of growing cells make a field with detail at all these scales. The loops have neither
branches nor calls, so that the compiler makes vector instructions of them.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from touchdown.sim.typing import Float32

_X, _Y, _Z = np.uint32(0x8DA6B343), np.uint32(0xD8163841), np.uint32(0xCB1AB31F)
_SCALE = np.float32(math.sqrt(3.0) / 2147483648.0)
"""Makes a signed word of 32 even bits a number of unit variance"""
_ONE, _TWO, _THREE = np.float32(1.0), np.float32(2.0), np.float32(3.0)


@njit(cache=True, forceinline=True, error_model="numpy")
def _node(place: np.uint32, salt: np.uint32) -> np.float32:
    """Hashed value of a node (finaliser "lowbias32" of Wellons, 2018)."""
    h = np.uint32(place ^ salt)
    h = np.uint32(h ^ (h >> np.uint32(16)))
    h = np.uint32(h * np.uint32(0x7FEB352D))
    h = np.uint32(h ^ (h >> np.uint32(15)))
    h = np.uint32(h * np.uint32(0x846CA68B))
    return np.float32(np.int32(h)) * _SCALE


@njit(cache=True, nogil=True, fastmath=True, forceinline=True, error_model="numpy")
def add_plane_noise(
    x: Float32, y: Float32, cell_m: float, salt: np.uint32, amplitude: Float32, out: Float32
) -> None:
    """Adds ``amplitude`` (N,) times the noise at (N,) ``x``, ``y`` to ``out`` (N,)."""
    scale = np.float32(1.0 / cell_m)
    for n in range(x.shape[0]):
        px, py = x[n] * scale, y[n] * scale
        fx, fy = np.floor(px), np.floor(py)
        u, v = px - fx, py - fy
        u, v = u * u * (_THREE - _TWO * u), v * v * (_THREE - _TWO * v)
        i, j = np.uint32(np.uint32(np.int32(fx)) * _X), np.uint32(np.uint32(np.int32(fy)) * _Y)
        i2, j2 = np.uint32(i + _X), np.uint32(j + _Y)
        a, b = _node(np.uint32(i ^ j), salt), _node(np.uint32(i2 ^ j), salt)
        c, d = _node(np.uint32(i ^ j2), salt), _node(np.uint32(i2 ^ j2), salt)
        low, high = a + (b - a) * u, c + (d - c) * u
        power = (_ONE - _TWO * u * (_ONE - u)) * (_ONE - _TWO * v * (_ONE - v))
        out[n] += amplitude[n] * (low + (high - low) * v) / np.sqrt(power)


@njit(cache=True, nogil=True, fastmath=True, forceinline=True, error_model="numpy")
def add_space_noise(
    x: Float32,
    y: Float32,
    z: Float32,
    cell_m: float,
    salt: np.uint32,
    amplitude: Float32,
    out: Float32,
) -> None:
    """As `add_plane_noise`, at (N,) ``x``, ``y``, ``z``."""
    scale = np.float32(1.0 / cell_m)
    for n in range(x.shape[0]):
        px, py, pz = x[n] * scale, y[n] * scale, z[n] * scale
        fx, fy, fz = np.floor(px), np.floor(py), np.floor(pz)
        u, v, w = px - fx, py - fy, pz - fz
        u, v = u * u * (_THREE - _TWO * u), v * v * (_THREE - _TWO * v)
        w = w * w * (_THREE - _TWO * w)
        i, j = np.uint32(np.uint32(np.int32(fx)) * _X), np.uint32(np.uint32(np.int32(fy)) * _Y)
        k = np.uint32(np.uint32(np.int32(fz)) * _Z)
        i2, j2, k2 = np.uint32(i + _X), np.uint32(j + _Y), np.uint32(k + _Z)
        a, b = _node(np.uint32(i ^ j ^ k), salt), _node(np.uint32(i2 ^ j ^ k), salt)
        c, d = _node(np.uint32(i ^ j2 ^ k), salt), _node(np.uint32(i2 ^ j2 ^ k), salt)
        low, high = a + (b - a) * u, c + (d - c) * u
        bottom = low + (high - low) * v
        a, b = _node(np.uint32(i ^ j ^ k2), salt), _node(np.uint32(i2 ^ j ^ k2), salt)
        c, d = _node(np.uint32(i ^ j2 ^ k2), salt), _node(np.uint32(i2 ^ j2 ^ k2), salt)
        low, high = a + (b - a) * u, c + (d - c) * u
        top = low + (high - low) * v
        power = (_ONE - _TWO * u * (_ONE - u)) * (_ONE - _TWO * v * (_ONE - v))
        power *= _ONE - _TWO * w * (_ONE - w)
        out[n] += amplitude[n] * (bottom + (top - bottom) * w) / np.sqrt(power)
