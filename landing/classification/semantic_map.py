"""The semantic map: class probabilities of the ground, fused over all views of the flight.

During the flight squares of ground are classified in turn, those first of which least is known, and
their predictions are added up in log-odds at nodes of a grid. A view counts by its reliability: by
the size of its pixels on the ground and its steepness, half in dim light, little where the image
looks like no known ground, and less where it was taken from nearly the same place as the one
before. Views of one network over one ground share its errors: together they count as
``landing.semantics.max_views`` at most.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import MapView
from touchdown.landing.api import (
    GroundClassifier,
    LandingParams,
    SemanticMapParams,
    SemanticView,
)
from touchdown.landing.classification.survey_images import PosedImage, SurveyImages
from touchdown.scenes.api import LAND_CLASSES
from touchdown.sim.typing import Array

_PERIOD_S = 0.1
_JITTER_S = 1e-3
_NODES = 96
"""along each side of the grid, around the take-off"""
_FLOOR = 1e-4
"""least probability of a class in one view"""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Grid:
    """Nodes (rows, cols) of the map, odom frame."""

    origin_xy_m: Array
    """(2,) of node (0, 0)"""
    spacing_m: float
    evidence: Array
    """(rows, cols, 7) sum of log-odds, weighted"""
    weight: Array
    """(rows, cols) sum of reliabilities"""
    seen_from: Array
    """(rows, cols, 3) position of the camera of the latest view; NaN without one"""


class SemanticMap:
    """The semantic map of one flight; ``update`` is called once a control step."""

    def __init__(self, classifier: GroundClassifier, params: LandingParams) -> None:
        self._classifier = classifier
        self._side_m = params.classifier_patch_m
        self._params = params.semantics
        self._next_s = -np.inf
        self._grid: _Grid | None = None

    def update(self, images: SurveyImages, map_view: MapView, now_s: float) -> None:
        """Classifies a few squares of the newest image, every tenth of a second."""
        view = images.newest_view()
        if self._params.squares == 0 or view is None or now_s < self._next_s:
            return
        self._next_s = now_s + _PERIOD_S - _JITTER_S
        grid = self._around(view)
        nodes, weights = self._worth_seeing(grid, view, images, map_view)
        if nodes.size == 0:
            return
        size = self._classifier.image_size
        sites = self._sites(grid, nodes, view, map_view)
        found = self._classifier.classify(
            np.stack([images.extract(view, site, self._side_m, size) for site in sites])
        )
        for (row, col), chance, known, weight in zip(
            nodes, found.probabilities, found.in_distribution, weights, strict=True
        ):
            counted = float(weight) if known else self._params.unfamiliar * float(weight)
            grid.evidence[row, col] += counted * log_odds(chance)
            grid.weight[row, col] += counted
            grid.seen_from[row, col] = view.position

    def view(self) -> SemanticView | None:
        """Returns the map; None while nothing was seen."""
        if self._grid is None or not self._grid.weight.any():
            return None
        return SemanticView(
            origin_xy_m=self._grid.origin_xy_m,
            spacing_m=self._grid.spacing_m,
            probabilities=fused(
                self._grid.evidence, self._grid.weight, self._params.max_views
            ).astype(np.float32),
            weight=self._grid.weight.astype(np.float32),
        )

    def with_view(self, xy_odom: Array, chance: Array, reliability: float = 1.0) -> Array:
        """Returns the probabilities (7,) at ``xy_odom`` (2,) of the map and of one more view of it,
        ``chance`` (7,). However often the map saw it, all its views count as ``max_views``
        beside the new one: many from afar do not outvote one from close by."""
        evidence, weight = reliability * log_odds(chance), reliability
        if self._grid is not None:
            row, col = np.rint(self._at(self._grid, xy_odom)).astype(int)
            if 0 <= row < _NODES and 0 <= col < _NODES:
                seen = float(self._grid.weight[row, col])
                counted = min(seen, self._params.max_views)
                evidence = evidence + self._grid.evidence[row, col] * (counted / max(seen, 1e-9))
                weight += counted
        return fused(evidence[None], np.array([weight]), self._params.max_views)[0]

    def _around(self, view: PosedImage) -> _Grid:
        if self._grid is None:
            spacing = 0.5 * self._side_m
            self._grid = _Grid(
                origin_xy_m=view.position[:2] - 0.5 * spacing * _NODES,
                spacing_m=spacing,
                evidence=np.zeros((_NODES, _NODES, len(LAND_CLASSES))),
                weight=np.zeros((_NODES, _NODES)),
                seen_from=np.full((_NODES, _NODES, 3), np.nan),
            )
        return self._grid

    @staticmethod
    def _at(grid: _Grid, xy: Array) -> Array:
        """Returns the row and column of ``xy`` (2,), with fractions."""
        return np.asarray((xy[:2] - grid.origin_xy_m)[::-1] / grid.spacing_m)

    def _worth_seeing(
        self, grid: _Grid, view: PosedImage, images: SurveyImages, map_view: MapView
    ) -> tuple[NDArray[np.int64], Array]:
        """Returns rows and columns (N, 2) of at most as many nodes as are classified at a time, and
        the reliability of the view of each."""
        reach = view.height_m / grid.spacing_m
        centre = self._at(grid, view.position)
        low = np.clip(np.floor(centre - reach), 0, _NODES).astype(int)
        high = np.clip(np.ceil(centre + reach) + 1, 0, _NODES).astype(int)
        rows, cols = np.meshgrid(
            np.arange(low[0], high[0]), np.arange(low[1], high[1]), indexing="ij"
        )
        nodes = np.column_stack([rows.ravel(), cols.ravel()])
        if nodes.size == 0:
            return nodes, np.zeros(0)
        sites = self._sites(grid, nodes, view, map_view)
        shown = images.shows(view, sites, self._side_m)
        before = grid.seen_from[nodes[:, 0], nodes[:, 1]]
        weights = shown * reliability(view, sites, self._params)
        weights *= novelty(view, before, self._params.apart)
        gain = weights / (1.0 + grid.weight[nodes[:, 0], nodes[:, 1]])
        best = np.argsort(-gain, kind="stable")[: self._params.squares]
        best = best[weights[best] > 0.05]
        return nodes[best], weights[best]

    @staticmethod
    def _sites(grid: _Grid, nodes: NDArray[np.int64], view: PosedImage, map_view: MapView) -> Array:
        """Returns the nodes on the ground (N, 3): at the height of the map, or where it has none at
        the level of the take-off."""
        xy = grid.origin_xy_m + grid.spacing_m * nodes[:, ::-1]
        coarse = map_view.coarse
        col, row = np.floor((xy - coarse.origin_xy_m) / coarse.cell_m).astype(int).T
        height = np.full(len(xy), view.ground_odom_m)
        inside = (row >= 0) & (col >= 0)
        inside &= (row < coarse.height_m.shape[0]) & (col < coarse.height_m.shape[1])
        known = coarse.height_m[row[inside], col[inside]]
        height[inside] = np.where(np.isfinite(known), known, height[inside])
        return np.column_stack([xy, height])


def log_odds(chance: Array) -> Array:
    """Returns the logarithms of probabilities (..., 7), less their mean: what Bayes' rule adds for
    one independent view under a uniform prior."""
    logs = np.log(np.maximum(chance, _FLOOR))
    return np.asarray(logs - logs.mean(axis=-1, keepdims=True))


def fused(evidence: Array, weight: Array, maximum: float) -> Array:
    """Returns the probabilities (..., 7) of sums of weighted log-odds (..., 7); ``weight`` (...) is
    the sum of their weights, of which at most ``maximum`` counts. Uniform without any."""
    scale = np.minimum(1.0, maximum / np.maximum(weight, 1e-9))
    odds = evidence * scale[..., None]
    grown = np.exp(odds - odds.max(axis=-1, keepdims=True))
    return np.asarray(grown / grown.sum(axis=-1, keepdims=True))


def reliability(view: PosedImage, sites: Array, params: SemanticMapParams) -> Array:
    """Returns how much a view counts at ``sites`` (N, 3), 0 to 1."""
    away = view.position - sites
    depth = np.maximum(away[:, 2], 0.1)
    pixel = depth * view.pixel_rad
    slant = np.hypot(away[:, 0], away[:, 1]) / depth
    sharp = 1.0 / (1.0 + np.maximum(pixel / params.full_pixel_m - 1.0, 0.0))
    return np.asarray(
        (params.dim if view.dim else 1.0) * sharp / (1.0 + (slant / params.half_slant) ** 2)
    )


def novelty(view: PosedImage, before: Array, apart: float) -> Array:
    """Returns 1 for nodes not seen before, else less the nearer the camera was, ``before`` (N, 3)
    or NaN, 0 in the same place."""
    away = np.linalg.norm(view.position - before, axis=1) / max(view.height_m, 1.0)
    return np.where(np.isnan(away), 1.0, 1.0 - np.exp(-((np.nan_to_num(away) / apart) ** 2)))
