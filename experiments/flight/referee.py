"""The referee: judges a flight on the true ground and ends it with an outcome."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from touchdown.estimator.api import Estimate
from touchdown.experiments.api import Outcome, RefereeParams
from touchdown.experiments.flight.metrics import (
    PERSON_M,
    Consistency,
    Nearest,
    PositioningError,
    TouchdownWindow,
    TrajectoryDeviation,
    velocity_over_deck,
)
from touchdown.experiments.io.result_parts import (
    JUDGED_BY_CLASS,
    JUDGED_BY_GEOMETRY,
    Landing,
    Nees,
    PositionError,
)
from touchdown.landing.api import LanderView, Phase
from touchdown.scenes.api import SAFE_CLASSES, Scene
from touchdown.sim.airframe.vehicle import vehicle_model
from touchdown.sim.api import Contact, MovingFrame, Truth
from touchdown.sim.frames import Pose, tilt_from_rotation
from touchdown.sim.typing import Array

if TYPE_CHECKING:
    from touchdown.scenes.truth.maps import TouchdownJudgement

_DESCENDING = frozenset({Phase.DESCEND, Phase.TOUCHDOWN, Phase.RETURN, Phase.DONE})
_LIFT_OFF_HEIGHT_M = 0.1
_NEES_HZ = 10.0
_REST_S = 0.5
_REST_SPEED_MPS = 0.05
_STOPPED_RADPS = 5.0
"""rotor speed below which rotors stand: the flight is over, whoever walks into its vehicle"""
STANDING_TOLERANCE_M = 0.05
"""Largest difference in height between a touching leg and the truth map: half of the step of 0.10 m
that the geometric rule allows, as a map that is further off cannot vouch for it. Feet sink in by
millimetres."""
_AROUND_M = 0.02 * np.stack(np.meshgrid(*2 * [np.arange(-1, 2)]), axis=-1).reshape(-1, 2)
"""(9, 2) offsets around a touching point: it may lie on an edge, or on the side of something"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Judgement:
    """Outcome and figures of one flight; ``landing`` is None where nothing was touched."""

    outcome: Outcome
    reason: str
    sim_s: float
    survey_s: float
    span_s: tuple[float | None, float | None]
    """lift-off and end of the survey, between which positions are judged"""
    position_error: PositionError
    deviation: TrajectoryDeviation
    nees: Nees
    landing: Landing | None


class Referee:
    """Judges every control step on the truth.

    ``ground``: the true ground. ``on_survey_end`` is called once.
    ``carried``: the vehicle follows a trajectory whatever its tilt.
    ``by_class``: the class of the ground counts as well as its geometry. ``commanded_xy_m``: the
    commanded site, stated in the result.
    """

    def __init__(
        self,
        params: RefereeParams,
        *,
        survey_only: bool,
        steps_per_s: float,
        ground: "TruthLookup",
        on_survey_end: Callable[[], None] = lambda: None,
        by_class: bool = False,
        commanded_xy_m: tuple[float, float] | None = None,
        carried: bool = False,
    ) -> None:
        self._params = params
        self._upright_cosine = math.cos(math.radians(180.0 if carried else params.tip_tilt_deg))
        self._survey_only = survey_only
        self._ground = ground
        self._moving_geoms = ground.moving_geoms
        self._on_survey_end = on_survey_end
        self._judged_on = JUDGED_BY_CLASS if by_class else JUDGED_BY_GEOMETRY
        self._commanded_xy_m = commanded_xy_m
        self._position_error = PositioningError()
        self._deviation = TrajectoryDeviation()
        self._consistency = Consistency()
        self._steps_per_sample = max(1, round(steps_per_s / _NEES_HZ))
        self._touchdown = TouchdownWindow(steps_per_s)
        self._people = Nearest(steps_per_s)
        self._start_height: float | None = None
        self._lift_off_s: float | None = None
        self._survey_from_s: float | None = None
        self._survey_to_s: float | None = None
        self._rest_since_s: float | None = None
        self._error_at_commit: float | None = None
        self._error_at_contact: float | None = None
        self._reason = ""
        self._last: tuple[Truth, LanderView] | None = None

    def judge(self, truth: Truth, estimate: Estimate, view: LanderView) -> Outcome | None:
        """Judges one control step; returns the outcome that ends the flight, or None."""
        self._last = (truth, view)
        estimated = estimate.world_from_body
        self._follow_phases(truth, view)
        if self._lift_off_s is not None and self._survey_to_s is None:
            self._position_error.add(estimated, truth.world_from_body)
            self._deviation.add(truth, view.reference_world)
            if self._position_error.count % self._steps_per_sample == 0:
                self._consistency.add(
                    estimated.translation,
                    truth.world_from_body.translation,
                    estimate.position_covariance,
                )
        if len(truth.living_world) and self._touchdown.contact_xy is None:
            self._people.add(truth)
        self._follow_touchdown(truth, view)
        true = truth.world_from_body.translation
        error_m = math.dist(estimated.translation.tolist(), true.tolist())
        self._follow_estimate(error_m, view)
        return (
            self._judge_estimate(error_m)
            or self._judge_attitude(truth)
            or self._judge_contacts(truth, view)
            or self._judge_end(truth, view)
        )

    def result(self, outcome: Outcome) -> Judgement:
        """Returns outcome and figures of the flight. Raises RuntimeError before a first judge."""
        if self._last is None:
            raise RuntimeError("result() before the first judge()")
        truth, view = self._last
        survey_s = 0.0
        if self._survey_from_s is not None:
            survey_s = (self._survey_to_s or truth.time_s) - self._survey_from_s
        landing = self._landing(truth, view)
        reason = self._reason or ("" if outcome is Outcome.COMPLETED else view.note)
        if landing is not None and landing.height_agrees is False:
            reason = "; ".join(filter(None, (reason, _off_the_map(landing.height_gap_m))))
        near = self._people.now_m
        if landing is not None and near is not None and near < PERSON_M:
            reason = "; ".join(filter(None, (reason, f"somebody is {near:.1f} m away: not safe")))
        return Judgement(
            outcome=outcome,
            reason=reason,
            sim_s=truth.time_s,
            survey_s=survey_s,
            span_s=(self._lift_off_s, self._survey_to_s),
            position_error=self._position_error.summary(),
            deviation=self._deviation,
            nees=self._consistency.summary(),
            landing=landing,
        )

    def _follow_phases(self, truth: Truth, view: LanderView) -> None:
        height = float(truth.world_from_body.translation[2])
        if self._start_height is None:
            self._start_height = height
        if self._lift_off_s is None and height > self._start_height + _LIFT_OFF_HEIGHT_M:
            self._lift_off_s = truth.time_s
        if (view.no_site or view.aborted) and not self._reason:
            self._reason = view.note  # of the abort, not of what follows it
        if self._survey_from_s is None and view.phase == Phase.SURVEY:
            self._survey_from_s = truth.time_s
        left_survey = self._survey_from_s is not None and view.phase != Phase.SURVEY
        if left_survey and self._survey_to_s is None:
            self._survey_to_s = truth.time_s
            self._on_survey_end()

    def _follow_touchdown(self, truth: Truth, view: LanderView) -> None:
        if self._lift_off_s is None:
            return
        touchdown = self._touchdown
        if touchdown.contact_xy is not None:
            touchdown.add_after(truth)
        elif truth.contacts and view.phase in _DESCENDING:
            touchdown.first_contact(truth)
            touchdown.add_after(truth)
        else:
            touchdown.add_before(truth)

    def _follow_estimate(self, error_m: float, view: LanderView) -> None:
        """Keeps the error of the estimate where the descent is committed, and where it ends."""
        committed = view.committed_site_world is not None and self._error_at_commit is None
        touched = self._touchdown.contact_xy is not None and self._error_at_contact is None
        if committed:
            self._error_at_commit = error_m
        if touched:
            self._error_at_contact = error_m

    def _judge_estimate(self, error_m: float) -> Outcome | None:
        if error_m <= self._params.divergence_m:
            return None
        self._reason = f"the estimate is {error_m:.1f} m off"  # or not a number
        return Outcome.DIVERGED

    def _judge_attitude(self, truth: Truth) -> Outcome | None:
        rotation = truth.world_from_body.rotation
        if rotation[2, 2] >= self._upright_cosine:
            return None
        tilt_deg = math.degrees(tilt_from_rotation(rotation))
        self._reason = f"tilted by {tilt_deg:.0f} degrees"
        return Outcome.TIPPED

    def _judge_contacts(self, truth: Truth, view: LanderView) -> Outcome | None:
        if self._lift_off_s is None or truth.time_s < self._lift_off_s + 1.0:
            return None
        # Beside a deck's rails it stands only where it does not slide.
        landed = self._touchdown.contact_xy is not None and truth.deck is None
        stands = landed and float(truth.rotor_speed_radps.max()) < _STOPPED_RADPS
        for contact in truth.contacts:
            with_moving = contact.other in self._moving_geoms - self._ground.decks
            if with_moving and stands:
                return self._ended(view)
            if contact.part != "leg" or with_moving or view.phase not in _DESCENDING:
                self._reason = f"{contact.part} touched {contact.other} in {view.phase}"
                return Outcome.COLLIDED
        return None

    def _judge_end(self, truth: Truth, view: LanderView) -> Outcome | None:
        over = self._survey_to_s is not None or view.phase == Phase.DONE
        if over and self._lift_off_s is None and not view.aborted:
            self._reason = "never took off"
            return Outcome.GROUNDED
        if view.phase == Phase.DONE:
            if self._survey_only:
                return Outcome.ABORTED if view.aborted else Outcome.COMPLETED
            if self._at_rest(truth):
                return self._ended(view)
        if truth.time_s >= self._params.timeout_s:
            self._reason = f"still {view.phase} after {truth.time_s:.0f} s"
            return Outcome.TIMEOUT
        return None

    @staticmethod
    def _ended(view: LanderView) -> Outcome:
        if view.no_site:
            return Outcome.NO_SITE
        return Outcome.ABORTED if view.aborted else Outcome.LANDED

    def _at_rest(self, truth: Truth) -> bool:
        speed = float(np.linalg.norm(velocity_over_deck(truth)))
        if speed > _REST_SPEED_MPS or not truth.contacts:
            self._rest_since_s = None
            return False
        if self._rest_since_s is None:
            self._rest_since_s = truth.time_s
        return truth.time_s - self._rest_since_s >= _REST_S

    def _landing(self, truth: Truth, view: LanderView) -> Landing | None:
        contact_xy = self._touchdown.contact_xy
        if contact_xy is None:
            return None
        on_deck = any(contact.other in self._ground.decks for contact in truth.contacts)
        if on_deck:
            assert truth.deck is not None
            verdict = self._ground.judge_on_deck(truth.world_from_body, truth.deck)
        else:
            verdict = self._ground.judge(contact_xy)
        gap = self._height_gap(truth)
        agrees = stands_on_truth(gap)
        # Where the truth map lacks what the vehicle stands on, it cannot vouch for anything there.
        known = agrees is not False
        site = view.committed_site_world
        moves = truth.deck is not None  # and has left the site that was committed
        offset = None if site is None or moves else float(np.linalg.norm(contact_xy - site[:2]))
        figures: dict[str, Any] = self._touchdown.summary() | self._people.summary()
        alone = self._people.now_m is None or self._people.now_m >= PERSON_M
        return Landing(
            commanded_xy_m=self._commanded_xy_m,
            site_xy_m=None if site is None else (float(site[0]), float(site[1])),
            touchdown_xy_m=(float(contact_xy[0]), float(contact_xy[1])),
            touchdown_time_s=self._touchdown.contact_time_s,
            target_offset_m=offset,
            estimate_error_at_commit_m=self._error_at_commit,
            estimate_error_at_contact_m=self._error_at_contact,
            slope_deg=verdict.slope_deg,
            roughness_m=verdict.roughness_m,
            **figures,
            obstacle_distance_m=verdict.obstacle_distance_m,
            class_predicted=view.site_class,
            class_probability=view.site_class_probability,
            class_true=verdict.land_class,
            height_gap_m=gap,
            height_agrees=agrees,
            safe_geometry=bool(verdict.safe_geometry) and known and alone,
            safe_class=verdict.land_class in SAFE_CLASSES and known,
            safe=bool(verdict.safe) and known and alone,
            judged_on=self._judged_on,
            landed_on=None if truth.deck is None else "deck" if on_deck else verdict.land_class,
        )

    def _height_gap(self, truth: Truth) -> float | None:
        """Of the first contact or of the last instant, whichever is larger in size."""
        gaps = [
            self._ground.height_gap_m(contacts)
            for contacts in (self._touchdown.contacts, truth.contacts)
        ]
        return max((gap for gap in gaps if gap is not None), key=abs, default=None)


def _off_the_map(height_gap_m: float | None) -> str:
    """The reason why a landing is not safe where the vehicle stands off the truth map."""
    if height_gap_m is None or math.isinf(height_gap_m):
        return "it stands where the truth map has no ground: not safe"
    side = "above" if height_gap_m > 0.0 else "below"
    return f"it stands {abs(height_gap_m):.2f} m {side} the truth map: not safe"


@dataclass(frozen=True)
class TruthLookup:
    """Looks up the true ground of a scene."""

    scene: Scene

    def judge(self, xy: Array) -> "TouchdownJudgement":
        """Judges the point ``xy`` (2,), world frame."""
        from touchdown.scenes.truth.maps import judge_touchdown

        return judge_touchdown(self.scene, xy)

    def surface_points(self, xy: Array, radius_m: float) -> Array:
        """(N, 3) points of the true surface on a grid of 5 cm in the disc around ``xy``."""
        from touchdown.scenes.truth.static_surface import cast_down

        cell = 0.05
        cells = int(radius_m / cell)
        side = 2 * cells + 1
        origin = xy - (cells + 0.5) * cell
        heights, _ = cast_down(self.scene, origin, cell, (side, side))
        rows, cols = np.mgrid[:side, :side]
        offsets = (np.stack([cols, rows], axis=-1) - cells) * cell
        near = (np.hypot(offsets[..., 0], offsets[..., 1]) <= radius_m) & np.isfinite(heights)
        return np.column_stack([xy + offsets[near], heights[near]])

    def height_gap_m(self, contacts: tuple[Contact, ...]) -> float | None:
        """The largest difference in height, in size, between the legs' contact points and the true
        surface around them, moving bodies left out; positive above it, infinite where the truth map
        has no surface, None without such a contact. A point between the lowest and the highest
        surface within 2 cm has none."""
        from touchdown.scenes.truth.static_surface import cast_points

        points = [
            contact.point_world
            for contact in contacts
            if contact.part == "leg"
            and contact.point_world is not None
            and contact.other not in self.moving_geoms
        ]
        if not points:
            return None
        touching = np.array(points)
        around = (touching[:, None, :2] + _AROUND_M).reshape(-1, 2)
        heights = cast_points(self.scene, around)[0].reshape(len(points), -1)
        known = np.isfinite(heights)
        highest = np.where(known, heights, -np.inf).max(axis=1)
        lowest = np.where(known, heights, np.inf).min(axis=1)
        above, below = touching[:, 2] - highest, lowest - touching[:, 2]
        gaps = np.where(above > 0.0, above, -np.maximum(below, 0.0))
        return float(gaps[np.argmax(np.abs(gaps))]) + 0.0  # no negative zero

    def judge_on_deck(self, world_from_body: Pose, deck: MovingFrame) -> "TouchdownJudgement":
        """Judges a vehicle that stands on a deck: safe where all of it is within the edges, which
        are its obstacles."""
        from touchdown.scenes.truth.maps import TouchdownJudgement

        geom = self.scene.model.geom(next(iter(self.decks)))
        at = deck.world_from_frame.inverse().apply(world_from_body.translation) - geom.pos
        room = float(np.min(geom.size[:2] - np.abs(at[:2])))
        safe = room > vehicle_model(self.scene.model).footprint_radius_m
        slope = math.degrees(tilt_from_rotation(deck.world_from_frame.rotation))
        land_class = self.scene.surfaces[geom.name].land_class
        return TouchdownJudgement(
            slope_deg=slope, roughness_m=0.0, safe_geometry=safe, land_class=land_class,
            safe=safe and land_class in SAFE_CLASSES, obstacle_distance_m=room,
        )  # fmt: skip

    @cached_property
    def decks(self) -> frozenset[str]:
        """Names of the geoms of moving bodies that can be landed on."""
        return frozenset(m.carries for m in self.scene.moving if m.carries)

    @cached_property
    def moving_geoms(self) -> frozenset[str]:
        """Names of the geoms of moving bodies and of all that hangs on them."""
        model = self.scene.model
        roots = {int(model.body(m.body_name).rootid[0]) for m in self.scene.moving}
        root_of_geom = model.body_rootid[model.geom_bodyid]
        return frozenset(
            model.geom(i).name for i in range(model.ngeom) if int(root_of_geom[i]) in roots
        )


def stands_on_truth(height_gap_m: float | None) -> bool | None:
    """False where a vehicle stands on something that the truth map does not have, or has at another
    height; None where it is not known."""
    return None if height_gap_m is None else abs(height_gap_m) <= STANDING_TOLERANCE_M
