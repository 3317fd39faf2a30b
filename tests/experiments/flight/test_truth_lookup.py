"""Heights at which a vehicle stands, against the truth map."""

import dataclasses
import gc
import weakref
from pathlib import Path

import mujoco
import numpy as np
import pytest

from touchdown.experiments.api import Outcome, RefereeParams
from touchdown.experiments.flight.referee import Referee
from touchdown.experiments.flight.truth_lookup import TruthLookup, stands_on_truth
from touchdown.experiments.io.result_parts import Landing
from touchdown.landing.api import Phase
from touchdown.scenes.api import VEHICLE_BODY, MovingBody, Scene
from touchdown.scenes.compose import load_scene
from touchdown.scenes.truth import static_surface
from touchdown.sim.airframe.contacts import ContactSensor
from touchdown.sim.api import Contact

from support.flight_fakes import make_estimate, make_truth, make_view

BOX = "<body><geom name='building' type='box' size='1 1 1' pos='6 0 1'/></body>"


def place(folder: Path, things: str) -> Scene:
    path = folder / "place.xml"
    path.write_text(
        f"<mujoco><worldbody><geom name='lawn' type='plane' size='40 40 1'/>{things}"
        "</worldbody></mujoco>",
        encoding="utf-8",
    )
    return load_scene(str(path), 0)


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


def test_a_vehicle_stands_on_the_truth_map(tmp_path: Path) -> None:
    """On the lawn, on a box, on a mound and on a slope: within millimetres."""
    scene = place(
        tmp_path,
        BOX + "<body pos='-8 0 0'><geom name='lawn_mound' type='ellipsoid' size='4 5 1'/></body>"
        "<geom name='field' type='box' size='4 4 1' pos='0 12 0' euler='8 5 30'/>",
    )
    lookup = TruthLookup(scene)
    for xy in ((0.0, 0.0), (6.0, 0.2), (-8.3, 0.4), (0.0, 12.0)):
        contacts = contacts_at(scene, xy)
        assert len(contacts) >= 3 and all(contact.part == "leg" for contact in contacts)
        gap = lookup.height_gap_m(contacts)
        assert gap is not None and abs(gap) < 0.005 and stands_on_truth(gap)


def test_a_box_that_the_truth_map_misses_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The vehicle stands on a box of 2 m, or half on a slab of 8 cm, that the map does not see."""
    slab = "<geom name='road' type='box' size='1 1 0.04' pos='0 6.95 0.04'/>"
    scene = place(tmp_path, BOX + slab)
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


def test_a_surface_is_kept_as_long_as_its_scene(tmp_path: Path) -> None:
    scene = place(tmp_path, BOX)
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


def test_what_is_seen_and_cannot_be_touched_is_noticed(tmp_path: Path) -> None:
    ghost = "type='box' size='2 2 0.2' pos='6 0 0.2' contype='0' conaffinity='0'"
    scene = place(tmp_path, f"<geom name='lawn_deck' {ghost}/>")
    standing = contacts_at(scene, (0.0, 0.0))
    moved = tuple(
        Contact(part="leg", other=c.other, normal_force_n=1.0,
                point_world=(c.point_world[0] + 6.0, *c.point_world[1:]))
        for c in standing if c.point_world is not None
    )  # fmt: skip
    assert TruthLookup(scene).height_gap_m(moved) == pytest.approx(-0.4, abs=0.005)


def leg(other: str, *point: float) -> Contact:
    return Contact(part="leg", other=other, normal_force_n=1.0, point_world=(*point,))  # type: ignore[arg-type]


def test_edges_and_sides_count_as_touched_where_they_are(tmp_path: Path) -> None:
    """At an edge of the box every height from the lawn to its top; nothing else."""
    lookup = TruthLookup(place(tmp_path, BOX))
    assert lookup.height_gap_m((leg("building", 5.001, 0.0, 1.2),)) == 0.0
    assert lookup.height_gap_m((leg("building", 4.99, 0.0, 1.2),)) == 0.0
    assert lookup.height_gap_m((leg("building", 4.9, 0.0, 1.2),)) == pytest.approx(1.2, abs=1e-4)
    assert lookup.height_gap_m((leg("lawn", 6.0, 0.0, 0.0),)) == pytest.approx(-2.0, abs=1e-4)
    far = lookup.height_gap_m((leg("lawn", 1e3, 0.0, 0.0),))
    assert far == np.inf and stands_on_truth(far) is False


def test_only_legs_on_fixed_things_count(tmp_path: Path) -> None:
    """Not the wings, nor what hangs on a moving body, however deep."""
    cart = (
        "<body name='cart' mocap='true' pos='3 3 0'><body><geom name='cart_bed' type='box' "
        "size='1 1 0.5' pos='0 0 0.5'/></body></body>"
    )
    scene = place(tmp_path, cart)
    path = MovingBody(body_name="cart", path_world=np.zeros((2, 3)), speed_mps=0.0, start_m=0.0)
    object.__setattr__(scene, "moving", (path,))
    lookup = TruthLookup(scene)
    assert lookup.moving_geoms == {"cart_bed"}
    assert lookup.surface_points(np.array([3.0, 3.0]), 0.3)[:, 2].max() == pytest.approx(0.0)
    assert lookup.height_gap_m((leg("cart_bed", 3.0, 3.0, 1.0),)) is None
    rotor = Contact(part="rotor", other="lawn", normal_force_n=1.0, point_world=(0.0, 0.0, 1.0))
    assert lookup.height_gap_m((rotor,)) is None and stands_on_truth(None) is None
