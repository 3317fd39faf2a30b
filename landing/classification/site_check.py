"""Is a site that the ground allows also a place to land on? Ground classification in flight.

A classifier sees squares of ground around the sites, best first and a few at a time, until one is
safe. What it says is weighed with what the LIDAR knows: pulses that never came back speak for
water, and something that moved on the same surface speaks for a road. An answer that is not sure
enough, a picture unlike any that the classifier knows, and no picture at all count as unsafe.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate, MapView
from touchdown.landing.api import Candidate, GroundClassifier, LandingParams, Selection
from touchdown.landing.classification.survey_images import SurveyImages
from touchdown.scenes.api import LAND_CLASSES, RISKY_CLASSES, SAFE_CLASSES
from touchdown.sim.api import Observation, SensorRig

Array = NDArray[np.float64]

_RECENT_S = 4.0
"""pictures that a look from lower down is made of"""
_LOST_OVER_LAND, _LOST_OVER_WATER = 0.01, 0.15
"""share of pulses that do not come back, on the whole; straight below, water answers like land"""
_INDEPENDENT = 20.0
"""pulses that count as independent of one another, however many there were"""
_DRIVEN = 20.0
"""how much likelier traffic is seen on a road than on other ground"""
_WATER, _ROAD = LAND_CLASSES.index("water"), LAND_CLASSES.index("road")


@dataclass(frozen=True, slots=True)
class SiteClass:
    """What the ground at a site is taken for."""

    probabilities: Array
    """(7,) of ``scenes.api.LAND_CLASSES``, the LIDAR's evidence included"""
    in_distribution: bool

    @property
    def name(self) -> str:
        return LAND_CLASSES[int(self.probabilities.argmax())]

    @property
    def probability(self) -> float:
        return float(self.probabilities.max())


class SiteClassCheck:
    """The lander's memory of pictures, and the classifier that looks at them."""

    def __init__(self, classifier: GroundClassifier, rig: SensorRig, params: LandingParams) -> None:
        self._classifier = classifier
        self._params = params
        self._min_probability = params.classifier_min_probability or classifier.min_probability
        self.images = SurveyImages(rig, params.classifier_images)
        self.batches = 0
        """that the classifier was asked for so far"""
        self._class_by_position: dict[bytes, SiteClass] = {}
        """by position, of the last call of ``judge``"""

    def update(self, obs: Observation, estimate: Estimate) -> None:
        """Call once a control step."""
        self.images.update(obs, estimate)

    def judge(
        self,
        candidates: Sequence[Candidate],
        map_view: MapView,
        *,
        selection: Selection | None = None,
        allow_risky: bool = False,
    ) -> list[Candidate]:
        """``candidates``, best first, in their order, with those refused whose ground is not safe;
        none is asked about after the batch with the first safe one. ``selection``: knows where
        traffic is."""
        judged = list(candidates)
        self._class_by_position.clear()
        queue = [number for number, site in enumerate(judged) if site.accepted]
        size = max(self._params.classifier_batch, 1)
        for first in range(0, len(queue), size):
            batch = queue[first : first + size]
            found = self._classify([judged[n].position_odom for n in batch], map_view, selection)
            for number, site_class in zip(batch, found, strict=True):
                judged[number] = self._marked(judged[number], site_class, allow_risky)
            if any(judged[number].accepted for number in batch):
                break
        return judged

    def reclassify(
        self, before: SiteClass | None, position_odom: Array, map_view: MapView, now_s: float
    ) -> SiteClass | None:
        """The site from lower down, at ``position_odom`` (3,), where it may have been moved to: by
        the pictures of the last seconds, or by older ones where those do not show it; None where
        none does. What it was taken for ``before``, from above, counts half."""
        for since in (now_s - _RECENT_S, -np.inf):
            (site_class,) = self._classify([position_odom], map_view, None, since)
            if site_class is not None:
                break
        if site_class is None or before is None:
            return site_class
        return SiteClass(
            0.5 * (site_class.probabilities + before.probabilities), site_class.in_distribution
        )

    def class_of(self, site: Candidate) -> SiteClass | None:
        """What a candidate of the last decision was taken for."""
        return self._class_by_position.get(site.position_odom.tobytes())

    def refusal(self, site_class: SiteClass | None, allow_risky: bool) -> str | None:
        """Why not to land there, in words; None: it is safe."""
        if site_class is None:
            return "no picture shows what kind of ground it is"
        what = f"{site_class.name} with probability {site_class.probability:.2f}"
        if not site_class.in_distribution:
            return f"it looks like no ground that is known, most like {what}"
        allowed = SAFE_CLASSES | RISKY_CLASSES if allow_risky else SAFE_CLASSES
        if site_class.name not in allowed:
            return f"it looks like {what}"
        sure = sum(
            float(probability)
            for name, probability in zip(LAND_CLASSES, site_class.probabilities, strict=True)
            if name in allowed
        )
        if sure < self._min_probability:
            return (
                f"unsure what it is: {what}, safe with probability {sure:.2f} "
                f"(at least {self._min_probability:.2f})"
            )
        return None

    def _marked(
        self, site: Candidate, site_class: SiteClass | None, allow_risky: bool
    ) -> Candidate:
        why = self.refusal(site_class, allow_risky)
        if site_class is None:
            return dataclasses.replace(site, accepted=False, reason=f"refused: {why}")
        self._class_by_position[site.position_odom.tobytes()] = site_class
        fine = f"{site.reason}, {site_class.name} with probability {site_class.probability:.2f}"
        return dataclasses.replace(
            site,
            accepted=why is None,
            reason=fine if why is None else f"refused: {why}",
            class_predicted=site_class.name,
            class_probability=site_class.probability,
        )

    def _classify(
        self,
        sites: Sequence[Array],
        map_view: MapView,
        selection: Selection | None,
        since_s: float = -np.inf,
    ) -> list[SiteClass | None]:
        """One for each site, from one batch."""
        size, side = self._classifier.image_size, self._params.classifier_patch_m
        patches = [self.images.patch(site, side, size, since_s) for site in sites]
        shown = [patch for patch in patches if patch is not None]
        found: list[SiteClass | None] = [None] * len(sites)
        if not shown:
            return found
        self.batches += 1
        prediction = self._classifier.classify(np.stack(shown))
        seen = [number for number, patch in enumerate(patches) if patch is not None]
        for row, number in enumerate(seen):
            missing, hits = pulses_around(map_view, sites[number], 0.5 * side)
            traffic_zone = selection is not None and in_traffic_zone(selection, sites[number])
            probabilities = fuse_lidar_evidence(
                prediction.probabilities[row], missing, hits, traffic_zone
            )
            found[number] = SiteClass(probabilities, bool(prediction.in_distribution[row]))
        return found


def least_bad(refused: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """``refused`` with one accepted, and first, where an emergency leaves no choice: the best that
    looks like ground that bears, else one of which nothing is known, else the first."""
    bearing = SAFE_CLASSES | RISKY_CLASSES
    better = [site for site in refused if site.class_predicted in bearing]
    unknown = [site for site in refused if site.class_predicted is None]
    for site in (*better, *unknown, *refused):
        words = site.reason.removeprefix("refused: ")
        taken = dataclasses.replace(site, accepted=True, reason=f"the least bad: {words}")
        return (taken, *(other for other in refused if other is not site))
    return ()


def fuse_lidar_evidence(
    probabilities: Array, missing: float, hits: float, traffic_zone: bool
) -> Array:
    """Probabilities (7,) of a picture together with what the LIDAR says, by Bayes' rule.

    Of the pulses around the site ``missing`` did not come back and ``hits`` did: lost ones make
    water likelier as a binomial count of at most 20 pulses does, but no loss proves no land, since
    water straight below answers too. ``driven``: something moved on the surface.
    """
    weights = np.array(probabilities, np.float64)
    pulses = missing + hits
    if pulses > 0.0:
        lost = min(pulses, _INDEPENDENT) * missing / pulses
        back = min(pulses, _INDEPENDENT) - lost
        ratio = lost * np.log(_LOST_OVER_WATER / _LOST_OVER_LAND)
        ratio += back * np.log((1.0 - _LOST_OVER_WATER) / (1.0 - _LOST_OVER_LAND))
        weights[_WATER] *= np.exp(max(ratio, 0.0))
    if traffic_zone:
        weights[_ROAD] *= _DRIVEN
    return np.asarray(weights / weights.sum())


def pulses_around(map_view: MapView, site_odom: Array, half_m: float) -> tuple[float, float]:
    """Pulses missing and seen in the square of the coarse map around a site."""
    grid = map_view.coarse
    low = np.floor((site_odom[:2] - half_m - grid.origin_xy_m) / grid.cell_m).astype(int)
    high = np.floor((site_odom[:2] + half_m - grid.origin_xy_m) / grid.cell_m).astype(int) + 1
    low, high = np.maximum(low, 0), np.maximum(high, 0)
    window = (slice(low[1], high[1]), slice(low[0], high[0]))
    return float(grid.missing[window].sum()), float(grid.count[window].sum())


def in_traffic_zone(selection: Selection, site_odom: Array) -> bool:
    """Whether a site lies near a surface on which something was seen to move."""
    costmap = selection.costmap
    if costmap is None or selection.traffic_zone.size == 0:
        return False
    col, row = np.floor((site_odom[:2] - costmap.origin_xy_m) / costmap.cell_m).astype(int)
    rows, cols = selection.traffic_zone.shape
    return 0 <= row < rows and 0 <= col < cols and bool(selection.traffic_zone[row, col])
