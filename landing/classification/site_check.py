"""Ground classification in flight: the check of candidate sites by the class of their ground.

Patches of ground around the sites are classified in batches, best site first, until one is safe.
The prediction is combined with LIDAR evidence: missing pulses indicate water, motion on the same
surface indicates a road, wide ground as bright as snow is snow. A site counts as unsafe where the
probability of a safe class is too low, where the image lies far from the training data, and where
no image shows the site. At night the last is left to the recheck, under the lamp.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from touchdown.estimator.api import Estimate, MapView
from touchdown.landing.api import (
    Candidate,
    GroundClassifier,
    LandingParams,
    Selection,
    SemanticView,
)
from touchdown.landing.classification.semantic_map import SemanticMap
from touchdown.landing.classification.snow import as_snow, is_snow
from touchdown.landing.classification.survey_images import SurveyImages, sharpness
from touchdown.landing.selection.ground.landable import Refusal
from touchdown.scenes.api import LAND_CLASSES, RISKY_CLASSES, SAFE_CLASSES
from touchdown.sim.api import Observation, SensorRig
from touchdown.sim.typing import Array

_RECENT_S = 4.0
"""age of the images that the recheck prefers"""
_MISSING_OVER_LAND, _MISSING_OVER_WATER = 0.01, 0.15
"""fraction of missing pulses on average; straight below, water returns pulses as land does"""
_INDEPENDENT = 20.0
"""largest number of pulses that count as independent"""
_TRAFFIC_RATIO = 20.0
"""likelihood ratio of motion on a road and on other ground"""
_BLURRED = 0.5
"""fraction of detail below which an image does not tell familiar ground from strange"""
_WATER, _ROAD = LAND_CLASSES.index("water"), LAND_CLASSES.index("road")


@dataclass(frozen=True, slots=True)
class SiteClass:
    """Predicted class of the ground at a site."""

    probabilities: Array
    """(7,) of ``scenes.api.LAND_CLASSES``, LIDAR evidence included"""
    in_distribution: bool
    """False where the image lies far from the training data"""
    detail: float = 1.0
    """fraction of the fine detail of a sharp picture, `survey_images.sharpness`"""

    @property
    def name(self) -> str:
        """The most probable class."""
        return LAND_CLASSES[int(self.probabilities.argmax())]

    @property
    def probability(self) -> float:
        """Of ``name``."""
        return float(self.probabilities.max())


class SiteClassCheck:
    """Survey images of the lander and the classifier of patches of them."""

    def __init__(self, classifier: GroundClassifier, rig: SensorRig, params: LandingParams) -> None:
        self._classifier = classifier
        self._params = params
        self._min_probability = params.classifier_min_probability or classifier.min_probability
        self.images = SurveyImages(rig, params.classifier_images)
        mapped = params.semantics.squares > 0 and "ground" in params.chosen_selector.terms
        self._semantics = SemanticMap(classifier, params) if mapped else None
        self.batches = 0
        """number of batches classified so far"""
        self._class_by_position: dict[bytes, SiteClass] = {}
        """by position of the site, of the last call of ``judge``"""

    def update(self, obs: Observation, estimate: Estimate, map_view: MapView) -> None:
        """Takes over the images of a control step; called once a step."""
        self.images.update(obs, estimate)
        if self._semantics is not None and estimate.healthy and obs.images:
            self._semantics.update(self.images, map_view, estimate.time_s)

    def semantic_view(self) -> SemanticView | None:
        """Returns the semantic map; None without one, and while nothing was seen."""
        return None if self._semantics is None else self._semantics.view()

    def judge(
        self,
        candidates: Sequence[Candidate],
        map_view: MapView,
        *,
        selection: Selection | None = None,
        allow_risky: bool = False,
    ) -> list[Candidate]:
        """Returns ``candidates`` in their order, best first; those on unsafe ground are refused.

        Candidates after the batch with the first safe one are not classified. ``selection`` gives
        the traffic zone. In the dark a site that no image shows is left to the recheck, under
        the lamp."""
        checked = list(candidates)
        self._class_by_position.clear()
        queue = [number for number, site in enumerate(checked) if site.accepted]
        size = max(self._params.classifier_batch, 1)
        for first in range(0, len(queue), size):
            batch = queue[first : first + size]
            found = self._classify([checked[n].position_odom for n in batch], map_view, selection)
            for number, site_class in zip(batch, found, strict=True):
                checked[number] = self._checked(checked[number], site_class, allow_risky)
            if any(checked[number].accepted for number in batch):
                break
        return checked

    def reclassify(
        self, before: SiteClass | None, position_odom: Array, map_view: MapView, now_s: float
    ) -> SiteClass | None:
        """Returns the class of the site at ``position_odom`` (3,), seen from closer.

        Uses the images of the last seconds, or older ones where those do not show it; None where
        no image does. With a semantic map the close view has the weight of
        ``landing.semantics.close`` others.
        Without one the prediction ``before``, from above, has half of the weight. Where the closer
        image is blurred and shows no ground of another kind, it adds little."""
        for since in (now_s - _RECENT_S, -np.inf):
            (site_class,) = self._classify([position_odom], map_view, None, since, closer=True)
            if site_class is not None:
                break
        if site_class is None or before is None or self._semantics is not None:
            return site_class
        against = site_class.name not in (before.name, *self._params.allowed_classes)
        weight = 0.5 if against else 0.5 * site_class.detail  # water and roofs are smooth, too
        clearer = before if weight < _BLURRED * 0.5 else site_class
        return SiteClass(
            weight * site_class.probabilities + (1.0 - weight) * before.probabilities,
            clearer.in_distribution,
        )

    def class_of(self, site: Candidate) -> SiteClass | None:
        """Returns the predicted class of a candidate of the last decision, None without one."""
        return self._class_by_position.get(site.position_odom.tobytes())

    def refusal(self, site_class: SiteClass | None, allow_risky: bool) -> Refusal | None:
        """Returns the reason against landing there; None where it is safe."""
        if site_class is None:
            return Refusal("no_image", "no image shows what kind of ground it is")
        refusal = self._refusal_of_class(site_class, allow_risky)
        if refusal is not None and self._params.unknown_ground == "geometry":
            sure = self._sure(site_class, allow_risky)
            if sure > 1.0 - self._params.unknown_unsafe_probability:
                return None
        return refusal

    def _sure(self, site_class: SiteClass, allow_risky: bool) -> float:
        """Probability of the allowed classes together."""
        allowed = {*self._params.allowed_classes, *(RISKY_CLASSES if allow_risky else ())}
        return sum(
            float(probability)
            for name, probability in zip(LAND_CLASSES, site_class.probabilities, strict=True)
            if name in allowed
        )

    def _refusal_of_class(self, site_class: SiteClass, allow_risky: bool) -> Refusal | None:
        what = f"{site_class.name} with probability {site_class.probability:.2f}"
        if not site_class.in_distribution:
            text = f"it looks like no known ground, most like {what}"
            return Refusal("unfamiliar_ground", text)
        allowed = {*self._params.allowed_classes, *(RISKY_CLASSES if allow_risky else ())}
        if site_class.name not in allowed:
            return Refusal("unsafe_ground", f"it looks like {what}")
        sure = self._sure(site_class, allow_risky)
        if sure < self._min_probability:
            return Refusal(
                "uncertain_ground",
                f"unsure what it is: {what}, safe with probability {sure:.2f} "
                f"(at least {self._min_probability:.2f})",
            )
        return None

    def _checked(
        self, site: Candidate, site_class: SiteClass | None, allow_risky: bool
    ) -> Candidate:
        why = self.refusal(site_class, allow_risky)
        if site_class is None and self.images.dark and self._params.site_recheck:
            later = f"{site.reason}, too dark to see what it is"
            return dataclasses.replace(site, reason=later)
        if why is not None:
            text = f"refused: {why.text}"
            site = dataclasses.replace(site, accepted=False, reason=text, rule=why.rule)
        if site_class is None:
            return site
        self._class_by_position[site.position_odom.tobytes()] = site_class
        fine = f"{site.reason}, {site_class.name} with probability {site_class.probability:.2f}"
        return dataclasses.replace(
            site,
            reason=fine if why is None else site.reason,
            class_predicted=site_class.name,
            class_probability=site_class.probability,
        )

    def _classify(
        self,
        sites: Sequence[Array],
        map_view: MapView,
        selection: Selection | None,
        since_s: float = -np.inf,
        closer: bool = False,
    ) -> list[SiteClass | None]:
        """Returns the class of each site, from one batch and the semantic map; None where no image
        shows it."""
        size, side = self._classifier.image_size, self._params.classifier_patch_m
        reliability = self._params.semantics.close if closer else 1.0
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
            predicted, detail = prediction.probabilities[row], sharpness(shown[row])
            if self._semantics is not None:
                against = LAND_CLASSES[int(predicted.argmax())] not in self._params.allowed_classes
                counted = reliability * (1.0 if against or not closer else detail)
                predicted = self._semantics.with_view(sites[number][:2], predicted, counted)
            if is_snow(map_view, sites[number], 0.5 * side):
                predicted = as_snow(predicted)
            probabilities = fuse_lidar_evidence(predicted, missing, hits, traffic_zone)
            known = bool(prediction.in_distribution[row])
            found[number] = SiteClass(probabilities, known, detail)
        return found


def least_bad(refused: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Returns ``refused`` with one site accepted and moved to the front, for an emergency: the
    first that is of a safe or risky class, else the first without a class, else the first."""
    solid = SAFE_CLASSES | RISKY_CLASSES
    better = [site for site in refused if site.class_predicted in solid]
    unknown = [site for site in refused if site.class_predicted is None]
    for site in (*better, *unknown, *refused):
        reason = site.reason.removeprefix("refused: ")
        taken = dataclasses.replace(
            site, accepted=True, reason=f"the least bad: {reason}", rule="least_bad"
        )
        return (taken, *(other for other in refused if other is not site))
    return ()


def fuse_lidar_evidence(
    probabilities: Array, missing: float, hits: float, traffic_zone: bool
) -> Array:
    """Returns the probabilities (7,) of an image combined with LIDAR evidence by Bayes' rule.

    ``missing`` and ``hits``: pulses around the site without and with a return. Missing ones raise
    the probability of water by a binomial likelihood of at most 20 pulses; without missing ones it
    is not lowered, since water straight below returns pulses too. ``traffic_zone``: motion was
    observed on the surface.
    """
    weights = np.array(probabilities, np.float64)
    pulses = missing + hits
    if pulses > 0.0:
        lost = min(pulses, _INDEPENDENT) * missing / pulses
        back = min(pulses, _INDEPENDENT) - lost
        ratio = lost * np.log(_MISSING_OVER_WATER / _MISSING_OVER_LAND)
        ratio += back * np.log((1.0 - _MISSING_OVER_WATER) / (1.0 - _MISSING_OVER_LAND))
        weights[_WATER] *= np.exp(max(ratio, 0.0))
    if traffic_zone:
        weights[_ROAD] *= _TRAFFIC_RATIO
    return np.asarray(weights / weights.sum())


def pulses_around(map_view: MapView, site_odom: Array, half_m: float) -> tuple[float, float]:
    """Returns the numbers of missing and of returned pulses in the square of the coarse map around
    a site."""
    grid = map_view.coarse
    low = np.floor((site_odom[:2] - half_m - grid.origin_xy_m) / grid.cell_m).astype(int)
    high = np.floor((site_odom[:2] + half_m - grid.origin_xy_m) / grid.cell_m).astype(int) + 1
    low, high = np.maximum(low, 0), np.maximum(high, 0)
    window = (slice(low[1], high[1]), slice(low[0], high[0]))
    return float(grid.missing[window].sum()), float(grid.count[window].sum())


def in_traffic_zone(selection: Selection, site_odom: Array) -> bool:
    """True if a site lies near a surface on which motion was observed."""
    costmap = selection.costmap
    if costmap is None or selection.traffic_zone.size == 0:
        return False
    col, row = np.floor((site_odom[:2] - costmap.origin_xy_m) / costmap.cell_m).astype(int)
    rows, cols = selection.traffic_zone.shape
    return 0 <= row < rows and 0 <= col < cols and bool(selection.traffic_zone[row, col])
