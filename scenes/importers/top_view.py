"""A file's scene seen from above, before the vehicle stands in it, and where the vehicle takes off
where the file names no place for it.

Sizes are those of the standard survey and of its fit to a place (`SurveyParams` and
`experiments.flight.survey_fit`, which are layers above; a test compares them).
"""

from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from touchdown.scenes.api import Array
from touchdown.sim.files.opening import quiet_libraries
from touchdown.sim.geometry.ray_target import RayTarget, TargetParts, geom_pose
from touchdown.sim.geometry.tessellation import geom_mesh, is_seen

Ids = NDArray[np.int32]
Mask = NDArray[np.bool_]

CELL_M = 0.5
STEP_M = 0.35
"""Between neighbouring cells of one ground: a kerb, a slab, a slope of 35 degrees."""
_SMALL_M = 4.0
"""Bounding radius of things that cells may miss"""
_TOP_M = 1000.0
_REACH_M = 250.0


class TopView(NamedTuple):
    """The top surface in cells, rows along y, cell (0, 0) at ``origin_xy_m``, world frame."""

    origin_xy_m: Array
    cell_m: float
    height_m: Array
    """(rows, cols) of the top surface, NaN where nothing is"""
    geom: Ids
    """(rows, cols) seen there, -1 for none"""

    def centres(self) -> Array:
        """(rows, cols, 2) world."""
        row, col = np.indices(self.geom.shape)
        return self.origin_xy_m + (np.stack([col, row], axis=-1) + 0.5) * self.cell_m

    def cell_of(self, xy_m: Array) -> tuple[int, int]:
        """Row and column of the cell at (2,) ``xy_m``, clipped to the raster."""
        col, row = np.floor((xy_m - self.origin_xy_m) / self.cell_m).astype(int)
        rows, cols = self.geom.shape
        return min(max(int(row), 0), rows - 1), min(max(int(col), 0), cols - 1)


class Place(NamedTuple):
    """The compiled scene of a file at time 0, and its top view."""

    model: Any
    data: Any
    seen: TopView
    bounds_xy_m: Array
    """[[x_min, y_min], [x_max, y_max]]"""

    @staticmethod
    def of(spec: Any, bounds_xy_m: Array) -> "Place":
        """Compiles a copy of ``spec``."""
        with quiet_libraries():
            model = spec.copy().compile()
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        return Place(model, data, top_view(model, data, bounds_xy_m), bounds_xy_m)

    def name(self, geom: int) -> str:
        return str(self.model.geom(geom).name)

    def rotation(self, geom: int) -> Array:
        """(3, 3) of a geom, world."""
        return np.asarray(self.data.geom_xmat[geom].reshape(3, 3))

    def box(self, geom: int) -> tuple[Array, Array]:
        """Middle (3,) and half sides (3,) of the world-aligned box around a geom."""
        rotation, box = self.rotation(geom), self.model.geom_aabb[geom]
        return rotation @ box[:3] + self.data.geom_xpos[geom], np.abs(rotation) @ box[3:]

    def is_kind(self, geom: int, *kinds: str) -> bool:
        """True for a geom of one of the ``kinds``, such as ``PLANE``."""
        return self.model.geom_type[geom] in [
            int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")) for kind in kinds
        ]

    def collides(self, geom: int) -> bool:
        return bool(self.model.geom_contype[geom] or self.model.geom_conaffinity[geom])

    def seen_m2(self, where: Mask | None = None) -> Array:
        """(G,) area of each geom that is seen from above, or seen in the cells ``where``."""
        cells = self.seen.geom >= 0
        ids = self.seen.geom[cells if where is None else cells & where]
        cells_of = np.bincount(ids, minlength=self.model.ngeom)
        return np.asarray(cells_of * self.seen.cell_m**2, np.float64)

    def with_small_things(self) -> TopView:
        """The top view with the boxes of geoms that are narrower than its cells, or nearly so."""
        height, cell_of = self.seen.height_m.copy(), self.seen.cell_of
        radius = self.model.geom_rbound
        for geom in np.flatnonzero((radius > 0.0) & (radius < _SMALL_M)).tolist():
            if is_seen(self.model, geom):
                middle, reach = self.box(geom)
                first, last = (cell_of(middle[:2] + side * reach[:2]) for side in (-1.0, 1.0))
                part = height[first[0] : last[0] + 1, first[1] : last[1] + 1]
                np.maximum(part, middle[2] + reach[2], out=part, where=np.isfinite(part))
        return self.seen._replace(height_m=height)

    def points(self) -> Array:
        """(N, 3) middles of the cells with something below, on the top surface."""
        high = self.seen.height_m
        return np.dstack([self.seen.centres(), high])[np.isfinite(high)]


def top_view(
    model: Any, data: Any, bounds_xy_m: Array, cell_m: float = CELL_M, only: int | None = None
) -> TopView:
    """Casts rays down at the geoms that are seen, or at one of them, within [[x_min, y_min],
    [x_max, y_max]]."""
    low, high = bounds_xy_m
    cols, rows = np.maximum(np.ceil((high - low) / cell_m - 1e-9).astype(int), 1)
    middle = np.array([*(0.5 * (low + high)), 0.0])
    parts = TargetParts.none(model)
    for geom in range(model.ngeom):
        if not is_seen(model, geom) or only not in (None, geom):
            continue
        pose = geom_pose(data, geom)
        around = pose.inverse().apply(middle)
        mesh = geom_mesh(model, geom, _REACH_M, None, (around[0], around[1]))
        parts.add(model, geom, pose, mesh)
    found = TopView(
        low.copy(), cell_m, np.full((rows, cols), np.nan), np.full((rows, cols), -1, np.int32)
    )
    if parts.geoms:
        rays = np.zeros((rows * cols, 6), np.float32)
        rays[:, :2] = found.centres().reshape(-1, 2)
        rays[:, 2], rays[:, 5] = _TOP_M, -1.0
        hits = RayTarget(parts).cast(rays)
        met = hits.geom >= 0
        found.height_m.ravel()[met] = _TOP_M - hits.distance[met].astype(np.float64)
        found.geom.ravel()[:] = hits.geom
    return found


def grounds(seen: TopView) -> NDArray[np.int32]:
    """(rows, cols) number of the connected surface of each cell, -1 for none: neighbours belong
    together where their heights differ by no more than `STEP_M`."""
    height = seen.height_m
    number = np.arange(height.size).reshape(height.shape)
    pairs = []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        near = np.abs(height[a] - height[b]) <= STEP_M  # of NaN: False
        pairs.append(np.stack([number[a][near], number[b][near]]))
    first, second = np.concatenate(pairs, axis=1)
    graph = coo_matrix((np.ones(first.size, np.int8), (first, second)), (height.size,) * 2)
    labels = connected_components(graph, directed=False)[1].reshape(height.shape)
    return np.where(np.isfinite(height), labels, -1).astype(np.int32)


def largest(labels: NDArray[np.int32]) -> int:
    """The number of the ground with the most cells; -1 where there is none."""
    known = labels[labels >= 0]
    return int(np.bincount(known).argmax()) if known.size else -1


def level_cells(seen: TopView, radius_m: float, max_m: float) -> Mask:
    """Cells around which heights differ by no more than ``max_m`` within ``radius_m``, all of them
    known."""
    reach = int(np.ceil(radius_m / seen.cell_m))
    row, col = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc = np.hypot(row, col) * seen.cell_m <= radius_m + 1e-9
    known = np.where(np.isfinite(seen.height_m), seen.height_m, 1e9)
    kind = {"footprint": disc, "mode": "constant", "cval": 1e9}
    spread = ndimage.maximum_filter(known, **kind) - ndimage.minimum_filter(known, **kind)
    return np.asarray(spread <= max_m) & (known < 1e9)


_AHEAD_M, _LEFT_M = 52.0, 42.0
"""The rectangle of the standard survey's legs, and a margin."""
_LENGTHS_M, _WIDTHS_M = (40.0, 32.0, 24.0, 16.0, 8.0), (0.0, 20.0, 40.0)
"""of the legs of smaller surveys"""
_TURN_M = 13.0
"""ground that turns between legs need beyond their ends"""
_SEEN_AHEAD_M, _SEEN_ASIDE_M = 12.0, 20.0
"""what LIDAR and camera see beyond the legs at 30 m"""
_ROOM = 0.95
"""least fraction of legs with ground below"""
_FREE_M, _LEVEL_M = 1.5, 0.12
"""Radius around a take-off that is level, and the heights within it."""
_FAR = 0.0003
"""Fraction of the survey that a metre's distance from the origin weighs."""


def takeoff_spot(seen: TopView, wish_xy_m: Array) -> Array:
    """The point (2,) ``wish_xy_m`` where it is level, free and leaves room for the survey, else the
    spot on the widest ground that does and is nearest. Where none leaves room for the standard
    survey, the one from which a smaller one sees most of the ground."""
    label = grounds(seen)
    usable = level_cells(seen, _FREE_M, _LEVEL_M) & (label == largest(label))
    if not usable.any():
        return wish_xy_m
    known = np.isfinite(seen.height_m)
    total = np.zeros((known.shape[0] + 1, known.shape[1] + 1))
    total[1:, 1:] = known.cumsum(axis=0).cumsum(axis=1) * seen.cell_m**2
    room = _below(total, seen.cell_m, (0.0, _AHEAD_M), (0.0, _LEFT_M)) / (_AHEAD_M * _LEFT_M)
    if room[usable].max() < _ROOM:
        room = _seen_by_smaller(total, seen.cell_m)
    here = seen.cell_of(wish_xy_m)
    if usable[here] and room[here] >= _ROOM:
        return wish_xy_m
    centres = seen.centres()
    away = np.hypot(*np.moveaxis(centres - wish_xy_m, -1, 0))
    cost = np.where(usable, 1.0 - room + _FAR * away, np.inf)
    return np.asarray(centres[np.unravel_index(int(np.argmin(cost)), cost.shape)], np.float64)


def _seen_by_smaller(total: Array, cell_m: float) -> Array:
    """(rows, cols) fraction of all ground, or of what the standard survey would see, that the best
    of the smaller surveys from a cell sees; 0 where there is no room for any."""
    best = np.zeros((total.shape[0] - 1, total.shape[1] - 1))
    for width in _WIDTHS_M:
        turn = _TURN_M if width else 0.0
        for length in _LENGTHS_M:
            legs = (-turn, length + max(turn, cell_m)), (-cell_m, width + cell_m)
            fraction = _below(total, cell_m, *legs) / _area(*legs)
            ground = _below(
                total, cell_m,
                (-_SEEN_AHEAD_M, length + _SEEN_AHEAD_M), (-_SEEN_ASIDE_M, width + _SEEN_ASIDE_M),
            )  # fmt: skip
            best = np.maximum(best, np.where(fraction >= _ROOM, ground, 0.0))
    maximum = (_AHEAD_M + 2.0 * _SEEN_AHEAD_M) * (_LEFT_M + 2.0 * _SEEN_ASIDE_M)
    return np.minimum(best / min(float(total[-1, -1]), maximum), 1.0)


def _below(
    total: Array, cell_m: float, ahead_m: tuple[float, float], left_m: tuple[float, float]
) -> Array:
    """(rows, cols) area of the ground in a rectangle ahead and to the left of a cell, heading east.
    ``total`` (rows + 1, cols + 1): sums of the ground's area up to a cell."""
    rows, cols = total.shape[0] - 1, total.shape[1] - 1
    bottom, top = (np.clip(np.arange(rows) + round(y / cell_m), 0, rows) for y in left_m)
    left, right = (np.clip(np.arange(cols) + round(x / cell_m), 0, cols) for x in ahead_m)
    return np.asarray(
        total[np.ix_(top, right)] - total[np.ix_(bottom, right)]
        - total[np.ix_(top, left)] + total[np.ix_(bottom, left)]
    )  # fmt: skip


def _area(ahead_m: tuple[float, float], left_m: tuple[float, float]) -> float:
    return (ahead_m[1] - ahead_m[0]) * (left_m[1] - left_m[0])
