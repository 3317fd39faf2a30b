"""A deck that moves: its waves, its course, and that it carries a vehicle."""

import dataclasses
from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.flight.wiring import build_scene, make_world
from touchdown.scenes.api import CARRIER, DeckParams, Scene, Sway
from touchdown.scenes.authoring.sea import SEA_STATES, hull_motion, wave_amplitudes
from touchdown.scenes.compose import load_scene
from touchdown.sim.api import Command
from touchdown.sim.frames import matrix_from_quat_wxyz, tilt_from_rotation
from touchdown.sim.moving import MovingBodies


@pytest.fixture(scope="module")
def boat() -> Scene:
    return load_scene("deck", 3)


def test_waves_have_the_significant_height_and_the_modal_period() -> None:
    rates = np.linspace(0.2, 8.0, 4000)
    amplitudes = wave_amplitudes(0.88, 7.5, rates)
    assert 4.0 * np.sqrt(0.5 * (amplitudes**2).sum()) == pytest.approx(0.88, rel=0.01)
    assert 2.0 * np.pi / rates[np.argmax(amplitudes)] == pytest.approx(7.5, rel=0.01)


def test_a_small_hull_follows_the_water_and_a_long_one_lies_still() -> None:
    rng = np.random.default_rng
    raft, ship = (hull_motion(rng(1), 4, size, 0.0) for size in ((0.1, 0.1), (200.0, 200.0)))
    raft_m, ship_m = (np.sqrt(0.5 * (one.amplitudes[:, 0] ** 2).sum()) for one in (raft, ship))
    assert 4.0 * raft_m == pytest.approx(SEA_STATES[4][0], rel=0.1) and ship_m < 0.15 * raft_m
    # the slope of the water is its wave number times its height
    slope = np.hypot(raft.amplitudes[:, 1], raft.amplitudes[:, 2])
    number = raft.rates_radps**2 / 9.81
    np.testing.assert_allclose(slope, number * np.abs(raft.amplitudes[:, 0]), rtol=1e-6)
    met = hull_motion(rng(1), 4, (0.1, 0.1), 5.0).rates_radps
    change = np.abs(met) - np.abs(raft.rates_radps)
    assert (change > 0.0).all() or (change < 0.5).all()  # of waves from ahead, or from astern


def test_heave_roll_and_pitch_turn_the_deck_as_they_say(boat: Scene) -> None:
    (body,) = boat.moving
    still = Sway(rates_radps=np.zeros(1), amplitudes=np.array([[0.5, 0.2, -0.1]]),
                 phases=np.zeros((1, 3)))  # fmt: skip
    swayed, level = (
        MovingBodies(_moving(boat, sway)).deck(4.0).world_from_frame for sway in (still, None)
    )
    np.testing.assert_allclose(swayed.translation - level.translation, [0.0, 0.0, 0.5], atol=1e-9)
    turned = level.rotation.T @ swayed.rotation
    assert turned[2, 1] == pytest.approx(np.sin(0.2) * np.cos(0.1))  # its left side is up
    assert turned[2, 0] == pytest.approx(np.sin(0.1))  # so is its bow
    assert body.carries == "deck_plate"


def _moving(scene: Scene, sway: Sway | None) -> Scene:
    (body,) = scene.moving
    return dataclasses.replace(scene, moving=(dataclasses.replace(body, sway=sway),))


def test_a_deck_goes_by_at_its_speed_and_a_barge_stays(boat: Scene) -> None:
    moving = MovingBodies(boat)
    motion = moving.deck(10.0)
    assert np.hypot(*motion.velocity_world[:2]) == pytest.approx(3.0, abs=1e-6)
    later = moving.deck(10.001).world_from_frame.translation
    np.testing.assert_allclose(
        later - motion.world_from_frame.translation, 1e-3 * motion.velocity_world, atol=1e-6
    )
    barge = load_scene("deck", 3, dials=DeckParams(kind="barge", sea_state=0))
    assert np.allclose(MovingBodies(barge).deck(50.0).velocity_world, 0.0)
    near = [np.linalg.norm(moving.deck(t).world_from_frame.translation[:2]) for t in range(40)]
    assert 13.0 < min(near) < 17.5 and 17 <= np.argmin(near) <= 23


def test_sensors_see_the_deck_and_touch_what_carries_it(boat: Scene) -> None:
    model = boat.model
    seen, carrier = model.body("deck").id, model.body(f"deck{CARRIER}").id
    touchable = model.geom_contype > 0
    assert not touchable[model.geom_bodyid == seen].any()
    assert touchable[model.geom_bodyid == carrier].all()
    assert (model.geom_group[model.geom_bodyid == carrier] >= 3).all()


@pytest.mark.parametrize("sea_state", [3, 6])
def test_water_never_covers_a_deck(sea_state: int) -> None:
    """What stands still lies as low as the deepest trough, and in calm seas where it did."""
    calm, scene = (load_scene("deck", 3, dials=DeckParams(sea_state=n)) for n in (0, sea_state))
    middles = [one.model.geom("water").pos[2] for one in (calm, scene)]
    sheet = -0.45 + middles[1] - middles[0]
    track = MovingBodies(scene).tracks(np.arange(0.0, 300.0, 0.1))["deck"]
    plate = scene.model.geom("deck_plate")
    signs = np.array([[x, y, 1.0] for x in (-1, 1) for y in (-1, 1)])
    corners = plate.pos + signs * plate.size
    lowest = min(
        (matrix_from_quat_wxyz(quat) @ corners.T)[2].min() + place[2]
        for place, quat in zip(track.positions, track.quats_wxyz, strict=True)
    )
    assert lowest > sheet - 0.05
    assert (abs(sheet + 0.45) < 1e-9) == (sea_state == 3) and sheet > -5.0


def test_a_tag_is_printed_in_the_middle_of_the_deck() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    read = cv2.aruco.ArucoDetector(dictionary).detectMarkers
    for tag_m in (1.2, 0.0):
        dials = DeckParams(kind="truck", tag_m=tag_m)
        model = load_scene("deck", 3, dials=dials).model
        of = model.texture("deck_top").id
        height, width, at = model.tex_height[of], model.tex_width[of], model.tex_adr[of]
        sheet = model.tex_data[at : at + 3 * height * width].reshape(height, width, 3)
        corners, numbers, _ = read(np.ascontiguousarray(sheet))
        assert (numbers is not None) == (tag_m > 0.0)
        if numbers is not None:
            assert numbers.ravel().tolist() == [0]
            side_px = np.linalg.norm(np.diff(corners[0][0], axis=0), axis=1)
            np.testing.assert_allclose(6.4 * side_px / width, tag_m, rtol=0.02)
            middle = corners[0][0].mean(axis=0)
            np.testing.assert_allclose(middle, [0.5 * width, 0.5 * height], atol=2.0)


@pytest.fixture
def world() -> Iterator[object]:
    config = load_config(scene="deck", seed=4, overrides=["deck.sea_state=4"], profile="ideal")
    made = make_world(config, build_scene(config))
    yield made
    made.close()


def test_the_deck_carries_a_vehicle_that_stands_on_it(world) -> None:  # type: ignore[no-untyped-def]
    """Set down at the deck's velocity with the rotors stopped, it stays on its place for ten
    seconds of waves, at 3 m/s."""
    deck = world.truth().deck
    plate = world.model.geom("deck_plate").pos
    at = deck.world_from_frame.apply(plate + [0.0, 0.0, 0.5])
    world.start_in_air(at, 0.0)
    vehicle = world.model.body("vehicle/quadrotor").dofadr[0]
    world.data.qvel[vehicle : vehicle + 3] = deck.velocity_at(at)
    places = []
    for _ in range(2000):
        world.step(Command(rotor_speed_radps=np.zeros(4)))
        truth = world.truth()
        inside = truth.deck.world_from_frame.inverse() @ truth.world_from_body
        places.append(inside.translation)
    settled = np.array(places[200:])
    assert np.ptp(settled, axis=0).max() < 0.06  # friction creeps
    assert tilt_from_rotation(inside.rotation) < np.radians(2.0)
    assert {contact.other for contact in truth.contacts} == {"deck_plate"}
