"""Bodies of a file that move: mocap bodies with a path among the file's custom elements.

``<numeric name="truck:path" data="x y z  x y z ..."/>`` and ``<numeric name="truck:speed"
data="2.5"/>`` send the mocap body ``truck`` round and round at one speed, from the first vertex on
or, with ``<text name="truck:start" data="seed"/>``, from one that the seed draws. ``truck:times``,
the seconds at which it is at each vertex, in place of a speed: it goes once. Its x axis is ahead.
"""

from typing import Any
from zlib import crc32

import numpy as np

from touchdown.scenes.api import MovingBody
from touchdown.sim.files.opening import printable
from touchdown.sim.typing import Array

_MOST = 10_000
"""vertices of a path"""
_FASTEST_MPS = 100.0


def movers(spec: Any, seed: int, origin_m: Array) -> tuple[MovingBody, ...]:
    """The bodies that move, whose paths count from ``origin_m`` (3,) of the file. Raises ValueError
    for a path that cannot be followed, in one sentence."""
    numbers = {one.name: np.asarray(one.data, float).ravel() for one in spec.numerics}
    texts = {one.name: one.data for one in spec.texts}
    names = [name[: -len(":path")] for name in numbers if name.endswith(":path")]
    return tuple(_mover(spec, name, numbers, texts, seed, origin_m) for name in names)


def _mover(
    spec: Any,
    name: str,
    numbers: dict[str, Array],
    texts: dict[str, str],
    seed: int,
    origin_m: Array,
) -> MovingBody:
    path, speed, times = (numbers.get(f"{name}:{part}") for part in ("path", "speed", "times"))
    start = texts.get(f"{name}:start", "")
    assert path is not None

    def check(holds: bool, why: str) -> None:
        if not holds:
            raise ValueError(f"{printable(name)}:path cannot be followed: {why}")

    body = spec.body(name)
    check(body is not None and bool(body.mocap), f"no body of the world is {name} with mocap=true")
    check(path.size % 3 == 0 and 6 <= path.size <= 3 * _MOST, f"2 to {_MOST} vertices are x y z")
    check(bool(np.isfinite(path).all()), "a number is not finite")
    vertices = path.reshape(-1, 3) - origin_m
    lengths = np.linalg.norm(np.diff(vertices, axis=0), axis=1)
    check(bool(lengths.sum() > 0.0), "its vertices are one place")
    check((speed is None) != (times is None), f"give {name}:speed, or {name}:times")
    check(start in ("", "seed") and not (start and times is not None),
          f"{name}:start may be seed, of a path with a speed")  # fmt: skip
    if times is not None:
        rising = times.size == len(vertices) and bool((np.diff(times) > 0.0).all())
        check(rising, f"{name}:times are not one for each vertex, rising")
        fastest = float(np.max(lengths / np.diff(times)))
        check(fastest <= _FASTEST_MPS, f"it goes at {fastest:.0f} m/s; {_FASTEST_MPS:g} at most")
        return MovingBody(body_name=name, path_world=vertices, times_s=times)
    assert speed is not None
    check(speed.size == 1 and 0.0 < speed[0] <= _FASTEST_MPS,
          f"its speed is not between 0 and {_FASTEST_MPS:g} m/s")  # fmt: skip
    way = float(lengths.sum() + np.linalg.norm(vertices[0] - vertices[-1]))
    drawn = np.random.default_rng([seed, crc32(name.encode())]).uniform(0.0, way)
    return MovingBody(
        body_name=name, path_world=vertices, speed_mps=float(speed[0]),
        start_m=drawn if start else 0.0,
    )  # fmt: skip
