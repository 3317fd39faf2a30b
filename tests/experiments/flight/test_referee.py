"""Every outcome, from sequences of a few ticks."""

import dataclasses
import gc
import weakref
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from touchdown.experiments.api import Outcome, RefereeParams
from touchdown.experiments.flight.referee import Referee, TruthLookup, stands_on_truth
from touchdown.experiments.io.result_parts import Landing
from touchdown.landing.api import Phase
from touchdown.scenes.api import VEHICLE_BODY, MovingBody, Scene
from touchdown.scenes.truth import static_surface
from touchdown.sim.airframe.contacts import ContactSensor
from touchdown.sim.api import Contact
from touchdown.sim.frames import Pose, so3_exp

from support.flight_fakes import LEG_ON_LAWN, make_estimate, make_truth, make_view
from support.places import scene_on_lawn

SAFE_LAWN = SimpleNamespace(
    slope_deg=1.0,
    roughness_m=0.01,
    safe_geometry=True,
    land_class="lawn",
    safe=True,
    obstacle_distance_m=4.0,
)


def ground(*gaps: float | None, verdict: SimpleNamespace = SAFE_LAWN) -> Any:
    """A true ground that is safe lawn everywhere, with a car that moves; each look at contacts
    takes one of ``gaps``."""
    left = iter(gaps)
    return SimpleNamespace(
        judge=lambda xy: verdict,
        height_gap_m=lambda contacts: next(left, None),
        moving_geoms=frozenset({"car"}),
        decks=frozenset(),
    )


def make_referee(**changes: Any) -> Referee:
    values: dict[str, Any] = {"survey_only": False, "steps_per_s": 200.0, "ground": ground()}
    return Referee(RefereeParams(timeout_s=100.0), **(values | changes))


def judge(
    referee: Referee, time_s: float, position: Any, phase: Phase, *, estimate: Any = None,
    view: dict[str, Any] | None = None, **truth: Any,
) -> Outcome | None:  # fmt: skip
    estimated = position if estimate is None else estimate
    return referee.judge(
        make_truth(time_s, position, **truth),
        make_estimate(time_s, estimated),
        make_view(phase, reference_world=np.asarray(position, float), **(view or {})),
    )


def descending(**changes: Any) -> Referee:
    """A referee of a flight as far as 1 m above the ground."""
    referee = make_referee(**changes)
    assert judge(referee, 0.0, [0, 0, 0.3], Phase.INIT, contacts=LEG_ON_LAWN) is None
    assert judge(referee, 1.0, [0, 0, 5.0], Phase.TAKEOFF) is None
    assert judge(referee, 10.0, [0, 0, 30.0], Phase.SURVEY, estimate=[0.1, 0, 30]) is None
    assert judge(referee, 46.0, [0, 0, 30.0], Phase.SELECT, estimate=[9.0, 0, 30]) is None
    assert judge(referee, 60.0, [5, 6, 1.0], Phase.DESCEND) is None
    return referee


def test_the_error_of_the_estimate_is_kept_at_commit_and_at_contact() -> None:
    referee = descending()
    site = {"committed_site_world": np.array([5.0, 6.0, 0.0])}
    steps = ((61.0, 0.9, 0.4, ()), (62.0, 0.5, 0.7, ()),
             (63.0, 0.3, 0.2, LEG_ON_LAWN), (64.0, 0.3, 0.6, LEG_ON_LAWN))  # fmt: skip
    for time_s, height, error, contacts in steps:
        judge(referee, time_s, [5, 6, height], Phase.DESCEND, estimate=[5 + error, 6, height],
              contacts=contacts, view=site)  # fmt: skip
    landing = referee.result(Outcome.LANDED).landing
    assert landing.estimate_error_at_commit_m == pytest.approx(0.4)
    assert landing.estimate_error_at_contact_m == pytest.approx(0.2)


def test_a_safe_landing() -> None:
    ended = []
    referee = descending(on_survey_end=lambda: ended.append(True), commanded_xy_m=(14.0, -33.5))
    assert referee.result(Outcome.ABORTED).landing is None
    site = {"committed_site_world": np.array([5.0, 6.1, 0.0])}
    landed = [
        judge(referee, time_s, [5, 6, 0.3], Phase.DONE, contacts=LEG_ON_LAWN, view=site)
        for time_s in (61.0, 61.2, 61.6)
    ]
    assert landed == [None, None, Outcome.LANDED]
    result = referee.result(Outcome.LANDED)
    assert ended == [True] and result.survey_s == pytest.approx(36.0)
    assert result.landing.target_offset_m == pytest.approx(0.1) and result.landing.safe is True
    landing = result.landing
    assert landing.touchdown_xy_m == (5.0, 6.0) and landing.touchdown_time_s == pytest.approx(61.0)
    assert landing.commanded_xy_m == (14.0, -33.5)
    # Two samples between lift-off and the survey's end: exact at 1 s, 0.1 m off at 10 s.
    assert result.position_error.mean == pytest.approx(0.05)


@pytest.mark.parametrize(("away_m", "safe", "reason"), [
    (2.9, False, "somebody is 2.9 m away: not safe"), (3.1, True, ""),
])  # fmt: skip
def test_nobody_may_stand_beside_a_touchdown(away_m: float, safe: bool, reason: str) -> None:
    referee = descending()
    people = np.array([[5.0 + away_m, 6.0, 0.0], [50.0, 0.0, 0.0]])
    for time_s in (61.0, 61.2):  # who comes closer after the first contact does not count
        judge(referee, time_s, [5, 6, 0.3], Phase.DONE, contacts=LEG_ON_LAWN, living_world=people)
        people = people - [1.0, 0.0, 0.0]
    result = referee.result(Outcome.LANDED)
    assert result.landing.nearest_person_m == pytest.approx(away_m)
    assert (result.landing.ground_safe, result.landing.safe) == (safe, safe)
    assert result.reason == reason


@pytest.mark.parametrize(("changes", "safe", "geometry", "by_class"), [
    ({"safe": False}, False, True, True),
    ({"safe": False, "safe_geometry": False, "slope_deg": 9.0}, False, False, True),
    ({"safe": False, "land_class": "water"}, False, True, False),
])  # fmt: skip
def test_the_verdict_on_the_ground_is_that_of_the_landing(
    changes: dict[str, Any], safe: bool, geometry: bool, by_class: bool
) -> None:
    verdict = SimpleNamespace(**(vars(SAFE_LAWN) | changes))
    referee = descending(ground=ground(verdict=verdict))
    judge(referee, 61.0, [5, 6, 0.3], Phase.DONE, contacts=LEG_ON_LAWN)
    landing = referee.result(Outcome.LANDED).landing
    assert (landing.safe, landing.safe_geometry, landing.safe_class) == (safe, geometry, by_class)
    assert (landing.slope_deg, landing.class_true) == (verdict.slope_deg, verdict.land_class)


def test_landed_is_who_rests_on_the_ground_for_half_a_second() -> None:
    referee = descending()
    sliding = {"velocity_world": np.array([0.1, 0.0, 0.0])}
    steps = ((61.0, LEG_ON_LAWN, {}), (61.4, LEG_ON_LAWN, sliding), (61.6, LEG_ON_LAWN, {}),
             (62.0, (), {}), (62.2, LEG_ON_LAWN, {}), (62.6, LEG_ON_LAWN, {}),
             (62.8, LEG_ON_LAWN, {}))  # fmt: skip
    outcomes = [
        judge(referee, time_s, [5, 6, 0.3], Phase.DONE, contacts=contacts, **more)
        for time_s, contacts, more in steps
    ]
    assert outcomes == [None] * 6 + [Outcome.LANDED]


def test_legs_may_touch_the_ground_for_a_second_after_lift_off() -> None:
    referee = make_referee()
    judge(referee, 0.0, [0, 0, 0.3], Phase.INIT)
    for time_s, expected in ((1.0, None), (1.9, None), (2.1, Outcome.COLLIDED)):
        found = judge(referee, time_s, [0, 0, 0.5], Phase.TAKEOFF, contacts=LEG_ON_LAWN)
        assert found is expected


def test_the_survey_is_judged_by_estimate_reference_and_covariance() -> None:
    """Ten samples a second of NEES at two errors of 3 m by unit covariance, and 2 m off the path;
    what comes before lift-off and after the survey does not count."""
    referee = make_referee(steps_per_s=20.0)
    reference = {"reference_world": np.array([0.0, 2.0, 30.0])}
    for step, (phase, height, error) in enumerate(
        [(Phase.INIT, 0.3, 9.0), *[(Phase.SURVEY, 30.0, 3.0)] * 4, (Phase.SELECT, 30.0, 9.0)]
    ):
        referee.judge(
            make_truth(0.05 * step, [0, 0, height]),
            make_estimate(0.05 * step, [error, 0, height]),
            make_view(phase, **reference),
        )
    result = referee.result(Outcome.COMPLETED)
    assert (result.nees.samples, result.nees.mean) == (2, pytest.approx(9.0))
    assert result.deviation.mean == pytest.approx(2.0)
    assert result.position_error.mean == pytest.approx(3.0)
    assert result.span_s == (pytest.approx(0.05), pytest.approx(0.25))


@pytest.mark.parametrize(("gaps", "largest", "agrees", "reason"), [
    ((0.004, -0.006), -0.006, True, ""), ((0.049, 0.0), 0.049, True, ""),
    ((0.051, 0.0), 0.051, False, "it stands 0.05 m above the truth map: not safe"),
    ((0.0, 2.3), 2.3, False, "it stands 2.30 m above the truth map: not safe"),
    ((0.0, -0.4), -0.4, False, "it stands 0.40 m below the truth map: not safe"),
    ((np.inf, 0.0), np.inf, False, "it stands where the truth map has no ground: not safe"),
    ((None, None), None, None, ""),
])  # fmt: skip
def test_a_landing_off_the_truth_map_is_never_safe(
    gaps: Any, largest: float | None, agrees: bool | None, reason: str
) -> None:
    """The gap at the first contact or at rest, whichever is larger."""
    referee = descending(ground=ground(*gaps))
    for time_s in (61.0, 61.2, 61.6):
        judge(referee, time_s, [5, 6, 0.3], Phase.DONE, contacts=LEG_ON_LAWN)
    result = referee.result(Outcome.LANDED)
    landing = result.landing
    assert landing.height_gap_m == (None if largest == np.inf else largest)
    assert (landing.height_agrees, result.reason) == (agrees, reason)
    safe = agrees is not False
    assert (landing.safe, landing.safe_geometry, landing.safe_class) == (safe, safe, safe)
    assert landing.ground_safe is safe


@pytest.mark.parametrize(
    ("flags", "expected"),
    [({"no_site": True}, Outcome.NO_SITE), ({"aborted": True}, Outcome.ABORTED)],
)
def test_honest_aborts(flags: dict[str, bool], expected: Outcome) -> None:
    referee = descending()
    judge(referee, 60.5, [5, 6, 1.0], Phase.RETURN, view=flags | {"note": "no place"})
    contact = {"contacts": LEG_ON_LAWN, "view": flags | {"note": "motors off"}}
    assert judge(referee, 61.0, [0, 0, 0.3], Phase.DONE, **contact) is None
    assert judge(referee, 61.6, [0, 0, 0.3], Phase.DONE, **contact) is expected
    assert referee.result(expected).reason == "no place"


@pytest.mark.parametrize("contact", [
    Contact(part="rotor", other="tree", normal_force_n=1.0),
    Contact(part="leg", other="car", normal_force_n=1.0),
])  # fmt: skip
def test_rotors_and_moving_things_must_not_be_touched(contact: Contact) -> None:
    referee = descending()
    turning = {"contacts": (contact,), "rotor_speed_radps": np.full(4, 60.0)}
    outcome = judge(referee, 61.0, [5, 6, 1.0], Phase.DESCEND, **turning)
    assert outcome is Outcome.COLLIDED and contact.other in referee.result(Outcome.COLLIDED).reason


@pytest.mark.parametrize(("flags", "expected"), [
    ({}, Outcome.LANDED), ({"no_site": True}, Outcome.NO_SITE), ({"aborted": True}, Outcome.ABORTED)
])  # fmt: skip
def test_who_walks_into_a_vehicle_whose_rotors_stand_ends_its_flight(
    flags: dict[str, bool], expected: Outcome
) -> None:
    for rotors, outcome in ((60.0, Outcome.COLLIDED), (0.0, expected)):
        referee = descending()
        now = {"rotor_speed_radps": np.full(4, rotors), "view": flags}
        assert judge(referee, 61.0, [5, 6, 0.3], Phase.DESCEND, contacts=LEG_ON_LAWN, **now) is None
        walks_in = (*LEG_ON_LAWN, Contact(part="rotor", other="car", normal_force_n=1.0))
        assert (
            judge(referee, 62.0, [5, 6, 0.3], Phase.TOUCHDOWN, contacts=walks_in, **now) is outcome
        )


def test_lost_tipped_and_late() -> None:
    assert judge(make_referee(), 0, [0, 0, 0], Phase.INIT, estimate=[21, 0, 0]) is Outcome.DIVERGED
    lost = judge(make_referee(), 0, [0, 0, 0], Phase.INIT, estimate=[np.nan, 0, 0])
    assert lost is Outcome.DIVERGED
    tipped = Pose(so3_exp(np.array([1.2, 0, 0])), np.zeros(3))
    assert judge(make_referee(), 0, [0, 0, 0], Phase.INIT, world_from_body=tipped) is Outcome.TIPPED
    assert judge(make_referee(), 100.0, [0, 0, 0], Phase.INIT) is Outcome.TIMEOUT


@pytest.mark.parametrize("survey_only", [True, False])
def test_a_survey_that_never_took_off_is_no_flight(survey_only: bool) -> None:
    """It shakes by 3 cm on its legs while it believes to be at 30 m."""
    referee = make_referee(survey_only=survey_only)
    story = ((0.0, 0.30, Phase.INIT), (5.0, 0.33, Phase.TAKEOFF), (16.0, 0.31, Phase.SURVEY))
    for time_s, height, phase in story:
        assert judge(referee, time_s, [0, 0, height], phase, contacts=LEG_ON_LAWN) is None
    after = Phase.DONE if survey_only else Phase.SELECT
    view = {"note": "surveying 1 legs of 10 m"}
    ended = judge(referee, 21.0, [0, 0, 0.3], after, contacts=LEG_ON_LAWN, view=view)
    assert ended is Outcome.GROUNDED
    result = referee.result(Outcome.GROUNDED)
    assert result.reason == "never took off" and result.span_s == (None, 21.0)
    assert result.deviation.count == 0
    assert set(result.position_error.model_dump().values()) == {None}


def test_a_survey_that_was_given_up_is_not_completed() -> None:
    referee = descending(survey_only=True)
    given_up = {"aborted": True, "note": "the position estimate stays unhealthy"}
    assert judge(referee, 61.0, [5, 6, 0.3], Phase.DONE, view=given_up) is Outcome.ABORTED
    assert "unhealthy" in referee.result(Outcome.ABORTED).reason


def test_survey_only_completes_without_touching_down() -> None:
    referee = make_referee(survey_only=True)
    judge(referee, 0.0, [0, 0, 0.3], Phase.INIT)
    judge(referee, 1.0, [0, 0, 5.0], Phase.SURVEY)
    done = judge(referee, 40.0, [0, 0, 30.0], Phase.DONE, view={"note": "surveying 3 legs of 50 m"})
    assert done is Outcome.COMPLETED
    result = referee.result(Outcome.COMPLETED)
    assert result.landing is None and result.reason == ""


BOX = "<body><geom name='building' type='box' size='1 1 1' pos='6 0 1'/></body>"


def contacts_at(scene: Scene, xy: tuple[float, float], seconds: float = 2.0) -> tuple[Contact, ...]:
    """What the vehicle touches when it has been let down at ``xy`` from above everything."""
    model = scene.model
    data = mujoco.MjData(model)
    start = TruthLookup(scene).surface_points(np.array(xy), 0.4)[:, 2].max()
    ground = TruthLookup(scene).surface_points(scene.takeoff_xy_m, 0.4)[:, 2].max()
    data.qpos[:3] = [*xy, data.qpos[2] + start - ground + 0.02]
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
    assert data.xpos[model.body(VEHICLE_BODY).id][:2] == pytest.approx(xy, abs=0.05)
    return ContactSensor(model).read(data)


def test_a_vehicle_stands_on_the_truth_map() -> None:
    """On the lawn, on a box, on a mound and on a slope: within millimetres."""
    scene = scene_on_lawn(
        BOX + "<body pos='-8 0 0'><geom name='lawn_mound' type='ellipsoid' size='4 5 1'/></body>"
        "<geom name='field' type='box' size='4 4 1' pos='0 12 0' euler='8 5 30'/>"
    )
    lookup = TruthLookup(scene)
    for xy in ((0.0, 0.0), (6.0, 0.2), (-8.3, 0.4), (0.0, 12.0)):
        contacts = contacts_at(scene, xy)
        assert len(contacts) >= 3 and all(contact.part == "leg" for contact in contacts)
        gap = lookup.height_gap_m(contacts)
        assert gap is not None and abs(gap) < 0.005 and stands_on_truth(gap)


def test_a_box_that_the_truth_map_misses_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The vehicle stands on a box of 2 m, or half on a slab of 8 cm, that the map does not see."""
    slab = "<geom name='road' type='box' size='1 1 0.04' pos='0 6.95 0.04'/>"
    scene = scene_on_lawn(BOX + slab)
    on_box, on_slab = contacts_at(scene, (6.0, 0.2)), contacts_at(scene, (0.0, 6.0))
    assert "road" in {contact.other for contact in on_slab}
    lawn = scene.model.geom("lawn").id
    monkeypatch.setattr(static_surface, "_recent", [])
    monkeypatch.setattr(static_surface, "_static_geoms", lambda _: np.array([lawn], np.int32))
    lookup = TruthLookup(scene)
    assert lookup.height_gap_m(on_box) == pytest.approx(2.0, abs=0.005)
    assert lookup.height_gap_m(on_slab) == pytest.approx(0.08, abs=0.005)
    assert lookup.judge(np.array([6.0, 0.2])).safe
    assert not stands_on_truth(lookup.height_gap_m(on_box))
    assert not stands_on_truth(lookup.height_gap_m(on_slab))
    landing = landing_at(lookup, (6.0, 0.2), on_box)
    assert landing.safe is False and landing.safe_geometry is False and not landing.ground_safe
    assert landing.height_gap_m == pytest.approx(2.0, abs=0.005)
    monkeypatch.undo()
    seen = landing_at(TruthLookup(scene), (6.0, 0.2), on_box)
    assert (seen.height_agrees, seen.class_true, seen.safe) == (True, "building", False)


def test_a_surface_is_kept_as_long_as_its_scene() -> None:
    scene = scene_on_lawn(BOX)
    assert static_surface.static_surface(scene) is static_surface.static_surface(scene)
    lit = dataclasses.replace(scene, light="night")
    assert static_surface.static_surface(lit) is static_surface.static_surface(scene)
    model = weakref.ref(scene.model)
    del scene, lit
    gc.collect()
    assert model() is None


def landing_at(
    lookup: TruthLookup, xy: tuple[float, float], contacts: tuple[Contact, ...]
) -> Landing:
    """What the referee says of a flight that ends with these contacts."""
    referee = Referee(RefereeParams(), survey_only=False, steps_per_s=200.0, ground=lookup)
    story = ((0.0, 0.3, Phase.INIT), (1.0, 5.0, Phase.TAKEOFF), (60.0, 3.0, Phase.DESCEND),
             (61.0, 2.3, Phase.TOUCHDOWN), (62.0, 2.3, Phase.DONE))  # fmt: skip
    for time_s, height, phase in story:
        place = np.array([*xy, height])
        truth = make_truth(time_s, place, contacts=contacts if time_s > 60.0 else ())
        referee.judge(truth, make_estimate(time_s, place), make_view(phase, reference_world=place))
    landing = referee.result(Outcome.LANDED).landing
    assert landing is not None
    return landing


def test_what_is_seen_and_cannot_be_touched_is_noticed() -> None:
    ghost = "type='box' size='2 2 0.2' pos='6 0 0.2' contype='0' conaffinity='0'"
    scene = scene_on_lawn(f"<geom name='lawn_deck' {ghost}/>")
    standing = contacts_at(scene, (0.0, 0.0))
    moved = tuple(
        Contact(part="leg", other=c.other, normal_force_n=1.0,
                point_world=(c.point_world[0] + 6.0, *c.point_world[1:]))
        for c in standing if c.point_world is not None
    )  # fmt: skip
    assert TruthLookup(scene).height_gap_m(moved) == pytest.approx(-0.4, abs=0.005)


def leg(other: str, *point: float) -> Contact:
    return Contact(part="leg", other=other, normal_force_n=1.0, point_world=(*point,))  # type: ignore[arg-type]


def test_edges_and_sides_count_as_touched_where_they_are() -> None:
    """At an edge of the box every height from the lawn to its top; nothing else."""
    lookup = TruthLookup(scene_on_lawn(BOX))
    assert lookup.height_gap_m((leg("building", 5.001, 0.0, 1.2),)) == 0.0
    assert lookup.height_gap_m((leg("building", 4.99, 0.0, 1.2),)) == 0.0
    assert lookup.height_gap_m((leg("building", 4.9, 0.0, 1.2),)) == pytest.approx(1.2, abs=1e-4)
    assert lookup.height_gap_m((leg("lawn", 6.0, 0.0, 0.0),)) == pytest.approx(-2.0, abs=1e-4)
    far = lookup.height_gap_m((leg("lawn", 1e3, 0.0, 0.0),))
    assert far == np.inf and stands_on_truth(far) is False


def test_only_legs_on_fixed_things_count() -> None:
    """Not the wings, nor what hangs on a moving body, however deep."""
    cart = (
        "<body name='cart' mocap='true' pos='3 3 0'><body><geom name='cart_bed' type='box' "
        "size='1 1 0.5' pos='0 0 0.5'/></body></body>"
    )
    scene = scene_on_lawn(cart)
    path = MovingBody(body_name="cart", path_world=np.zeros((2, 3)), speed_mps=0.0, start_m=0.0)
    object.__setattr__(scene, "moving", (path,))
    lookup = TruthLookup(scene)
    assert lookup.moving_geoms == {"cart_bed"}
    assert lookup.surface_points(np.array([3.0, 3.0]), 0.3)[:, 2].max() == pytest.approx(0.0)
    assert lookup.height_gap_m((leg("cart_bed", 3.0, 3.0, 1.0),)) is None
    rotor = Contact(part="rotor", other="lawn", normal_force_n=1.0, point_world=(0.0, 0.0, 1.0))
    assert lookup.height_gap_m((rotor,)) is None and stands_on_truth(None) is None
