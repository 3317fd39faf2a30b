"""Place recognition in flight: what is looked at, what is believed, and what is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from landing_support import make_estimate, make_grid, make_obs, view_of
from numpy.typing import NDArray
from place_support import COLOURS, ByColour, photograph, plain, small_rig, write_colour_network

from landing.api import Candidate, LandingParams, Selection
from landing.place_check import PlaceCheck, SitePlace, least_bad, weighed
from landing.place_pictures import KeptPictures, project
from landing.recognition import decision, weights
from landing.recognition.labels import D_LAND
from landing.selector import select_sites
from sim.api import CameraImage
from sim.frames import Pose, rotation_from_yaw, so3_exp

Array = NDArray[np.float64]
ABOVE = Pose(np.eye(3), np.array([0.0, 0.0, 20.0]))
SURE = 0.97


def _chances(**given: float) -> Array:
    """Probabilities of the named classes, the rest shared by the others."""
    others = [name for name in D_LAND if name not in given]
    left = (1.0 - sum(given.values())) / len(others)
    return np.array([given.get(name, left) for name in D_LAND])


def _scores(*rows: Array) -> NDArray[np.float32]:
    return np.log(np.array(rows)).astype(np.float32)


# --------------------------------------------------------------------------------------- decision


def test_energy_is_the_logarithm_of_the_sum_of_exponentials() -> None:
    scores = np.array([[0.0, np.log(3.0)], [500.0, 500.0]], np.float32)
    np.testing.assert_allclose(
        decision.energies(scores), [np.log(4.0), 500.0 + np.log(2.0)], rtol=1e-6
    )


def test_safe_classes_count_together() -> None:
    """Half lawn, half field is safe ground all the same; half lawn, half water is not."""
    scores = _scores(_chances(lawn=0.5, field=0.46), _chances(lawn=0.55, water=0.44))
    limits = decision.Limits(least_probability=0.9)
    assert decision.taken_for_safe(scores, limits).tolist() == [True, False]
    strange = dataclasses.replace(limits, least_energy=1.0)
    assert not decision.taken_for_safe(scores, strange).any()


def test_limits_let_a_quarter_of_a_percent_of_unsafe_pictures_pass() -> None:
    """800 pictures of water, claimed to be lawn with 0.5 to 0.9: two of them may pass."""
    claims = np.linspace(0.5, 0.9, 800)
    rows = [_chances(lawn=float(claim)) for claim in claims]
    labels = np.full(800, D_LAND.index("water"))
    limits = decision.fitted_limits(_scores(*rows), labels)
    taken = decision.taken_for_safe(_scores(*rows), limits)
    assert np.flatnonzero(taken).tolist() == [798, 799]
    found = decision.decision_summary(_scores(*rows), labels, limits)
    assert (found["unsafe"], found["unsafe_taken_for_safe"], found["safe"]) == (800, 2, 0)
    easy = decision.fitted_limits(_scores(_chances(lawn=SURE)), np.array([D_LAND.index("lawn")]))
    assert easy.least_probability == decision.LEAST


def test_a_file_carries_its_limits_and_an_older_one_does_without() -> None:
    limits = decision.Limits(least_probability=0.8125, least_energy=-0.7)
    facts = weights.NetworkFacts(
        network="resnet18", labels="d_land", image_size=96, classes=D_LAND, limits=limits
    )
    kept = facts.properties()
    assert weights.facts_of(kept, Path("n.onnx")) == facts
    for name in ("least_probability", "least_energy"):
        del kept[name]
    assert weights.facts_of(kept, Path("n.onnx")).limits == decision.Limits()


# --------------------------------------------------------------------------------------- pictures


def _by_place(x: Array, y: Array) -> Array:
    """Red is east, green north: 4 levels a metre about 128."""
    return np.stack([128.0 + 4.0 * x, 128.0 + 4.0 * y, np.zeros_like(x)], -1)


def _kept(pose: Pose, paint: Any = _by_place, rig: Any = None, **more: Any) -> KeptPictures:
    rig = rig or small_rig()
    pictures = KeptPictures(rig, more.get("limit", 8))
    obs = make_obs(600, images=(photograph(rig, pose, paint, 1.0),))
    pictures.take_in(obs, make_estimate(600, pose))
    return pictures


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
def test_a_square_shows_the_ground_around_a_site(yaw: float) -> None:
    """Tilted by 4 degrees, 20 m up, 2 m aside: the square is level, centred, and not mirrored."""
    tilt = so3_exp(np.radians([4.0, -2.0, 0.0]))
    pose = Pose(rotation_from_yaw(yaw) @ tilt, np.array([1.0, -2.0, 20.0]))
    site = np.array([3.0, -1.0, 0.0])
    square = _kept(pose).square(site, 6.4, 64)
    assert square is not None and square.shape == (64, 64, 3)
    place = (square[..., :2].astype(float) - 128.0) / 4.0
    assert place.mean(axis=(0, 1)) == pytest.approx(site[:2], abs=0.05)
    right = (place[:, -8:] - place[:, :8]).mean(axis=(0, 1)) / (56 / 64)
    down = (place[-8:] - place[:8]).mean(axis=(0, 1)) / (56 / 64)
    assert np.linalg.norm(right) == pytest.approx(6.4, abs=0.2)
    assert np.linalg.norm(down) == pytest.approx(6.4, abs=0.2)
    assert right @ down == pytest.approx(0.0, abs=1.0)
    assert right[0] * down[1] - right[1] * down[0] < 0.0  # seen from above


def test_the_lens_is_taken_out() -> None:
    """OpenCV's own projection, with all five coefficients."""
    import cv2

    camera = dataclasses.replace(
        small_rig().camera, distortion=np.array([-0.2, 0.05, 0.001, -0.002, 0.01])
    )
    points = np.random.default_rng([7, 1]).uniform([-3, -2, 4], [3, 2, 9], (20, 3))
    own, ahead = project(camera, points)
    theirs, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera.matrix(), camera.distortion
    )
    np.testing.assert_allclose(own, theirs[:, 0], atol=1e-9)
    assert ahead.all() and not project(camera, -points)[1].any()


def test_a_smaller_square_where_the_whole_one_is_not_shown() -> None:
    """At 5 m the picture shows 3.9 m the short way: half of 6.4 m fits, nothing of a site aside."""
    pictures = _kept(Pose(np.eye(3), np.array([0.0, 0.0, 5.0])))
    square = pictures.square(np.zeros(3), 6.4, 32)
    assert square is not None
    width = (float(square[:, -1, :2].mean()) - float(square[:, 0, :2].mean())) / 2.0
    assert abs(width) == pytest.approx(0.5 * 6.4 * 31 / 32, abs=0.4)
    assert pictures.square(np.array([0.0, 9.0, 0.0]), 6.4, 32) is None
    assert pictures.square(np.zeros(3), 6.4, 32, since_s=1.5) is None


def test_kept_pictures_are_few_and_apart() -> None:
    rig = small_rig()
    pictures = KeptPictures(rig, 5)
    rng = np.random.default_rng(7)
    sources = [
        rng.integers(0, 255, (rig.camera.height, rig.camera.width, 3)).astype(np.uint8)
        for _ in range(60)
    ]
    for step, source in enumerate(sources):  # 1 m a step at 20 m: one in four is kept
        pose = Pose(np.eye(3), np.array([float(step), 0.0, 20.0]))
        image = photograph(rig, pose, plain("lawn"), step / 10.0)
        obs = make_obs(60 * step, images=(dataclasses.replace(image, rgb=source),))
        estimate = make_estimate(60 * step, pose)
        pictures.take_in(obs, dataclasses.replace(estimate, healthy=step != 16))
    assert 4 <= len(pictures) <= 5
    places = sorted(kept.odom_from_camera.translation[0] for kept in pictures._kept)
    assert places[0] == 0.0 and 16.0 not in places
    assert np.diff(places).min() >= 8.0 and places[-1] >= 40.0
    assert all(kept.rgb is not source for kept in pictures._kept for source in sources)


def test_what_is_black_frozen_or_out_of_order_is_no_ground() -> None:
    """5 m a step at 20 m; at odd steps something is wrong."""
    rig = small_rig()
    pictures = KeptPictures(rig, 8)
    images = []
    for step in range(10):
        pose = Pose(np.eye(3), np.array([5.0 * step, 0.0, 20.0]))
        images.append(photograph(rig, pose, plain("lawn"), 1.0 + step / 10.0))
    images[1] = dataclasses.replace(images[1], rgb=np.zeros_like(images[1].rgb))
    images[3] = dataclasses.replace(images[3], rgb=images[2].rgb)
    images[5] = dataclasses.replace(images[5], time_s=images[4].time_s)
    for step in range(6):
        pose = Pose(np.eye(3), np.array([5.0 * step, 0.0, 20.0]))
        estimate = make_estimate(600 + 60 * step, pose)
        pictures.take_in(make_obs(600 + 60 * step, images=(images[step],)), estimate)
    assert [kept.time_s for kept in pictures._kept] == [1.0, 1.2, 1.4]
    swapped = (images[7], images[6])
    pictures.take_in(make_obs(1080, images=swapped), make_estimate(1080, pose))
    assert len(pictures) == 3
    pictures.take_in(make_obs(1140, images=(images[8],)), make_estimate(1140, pose))
    assert pictures._newest is not None and pictures._newest.time_s == 1.8


def test_an_exposure_is_placed_where_the_vehicle_was() -> None:
    """The picture arrives 60 ms after its exposure, 0.3 m further on."""
    rig = small_rig()
    pictures = KeptPictures(rig, 4)
    for step in range(13):
        pose = Pose(np.eye(3), np.array([0.025 * step, 0.0, 20.0]))
        images: tuple[CameraImage, ...] = ()
        if step == 12:
            there = Pose(np.eye(3), np.array([0.0125, 0.0, 20.0]))
            images = (photograph(rig, there, _by_place, 0.0025),)
        pictures.take_in(make_obs(3 * step, images=images), make_estimate(3 * step, pose))
    assert pictures._kept[0].odom_from_camera.translation[0] == pytest.approx(0.0125)


# ------------------------------------------------------------------------------------------ sites


def _sites(*xy: tuple[float, float]) -> list[Candidate]:
    return [
        Candidate(
            position_odom=np.array([x, y, 0.0]), normal_odom=np.array([0.0, 0.0, 1.0]), score=0.5,
            flatness=0.5, smoothness=0.5, distance=0.5, slope_deg=0.0, roughness_m=0.0,
            clearance_m=3.0, accepted=True, reason="landable",
        )
        for x, y in xy
    ]  # fmt: skip


def _west_is_water(x: Array, y: Array) -> Array:
    return np.where((x < 0.0)[..., None], COLOURS["water"], COLOURS["lawn"]).astype(float)


def _check(classifier: Any, paint: Any = _west_is_water, **params: Any) -> PlaceCheck:
    rig = small_rig()
    check = PlaceCheck(classifier, rig, LandingParams(**params))
    obs = make_obs(
        600, images=(photograph(rig, Pose(np.eye(3), np.array([0, 0, 40.0])), paint, 1.0),)
    )
    check.take_in(obs, make_estimate(600, Pose(np.eye(3), np.array([0, 0, 40.0]))))
    return check


FLAT = view_of(make_grid(np.zeros((200, 200)), origin=(-20.0, -20.0)))


def test_water_is_refused_and_the_first_safe_batch_ends_it() -> None:
    classifier = ByColour()
    sites = _sites((-9, 0), (-8, 5), (-12, -5), (-9, 4), (8, 0), (9, 5), (10, -5), (12, 0))
    judged = _check(classifier).judge(sites, FLAT)
    assert classifier.batches == [3, 3]
    assert [site.accepted for site in judged] == [False] * 4 + [True] * 4
    assert judged[0].reason == "refused: it looks like water with probability 0.97"
    assert (judged[0].class_predicted, judged[4].class_predicted) == ("water", "lawn")
    assert judged[4].reason == "landable, lawn with probability 0.97"
    assert judged[4].class_probability == pytest.approx(SURE)
    assert judged[6] is sites[6] and judged[7].class_predicted is None


def test_refused_sites_are_not_asked_about() -> None:
    classifier = ByColour()
    bad, good = _sites((-9, 0), (9, 0))
    bad = dataclasses.replace(bad, accepted=False, reason="refused: a step")
    judged = _check(classifier).judge([bad, good], FLAT)
    assert classifier.batches == [1] and judged[0] is bad and judged[1].accepted


@pytest.mark.parametrize(
    ("classifier", "words"),
    [
        (ByColour(sure=0.6), "unsure what it is: lawn with probability 0.60"),
        (ByColour(familiar=False), "it looks like no ground that is known"),
    ],
)
def test_who_is_not_sure_is_not_believed(classifier: ByColour, words: str) -> None:
    (site,) = _check(classifier).judge(_sites((9, 0)), FLAT)
    assert not site.accepted and words in site.reason
    assert site.class_predicted == "lawn"


def test_the_configuration_may_ask_for_more_or_less() -> None:
    (site,) = _check(ByColour(sure=0.6), place_least_probability=0.55).judge(_sites((9, 0)), FLAT)
    assert site.accepted
    (site,) = _check(ByColour(), place_least_probability=0.999).judge(_sites((9, 0)), FLAT)
    assert "(at least 1.00)" in site.reason and not site.accepted


def test_what_no_picture_shows_is_refused() -> None:
    classifier = ByColour()
    (site,) = _check(classifier).judge(_sites((60, 0)), FLAT)
    assert site.reason == "refused: no picture shows what kind of ground it is"
    assert classifier.batches == [] and site.class_predicted is None


def test_roads_are_taken_only_where_they_are_allowed() -> None:
    for allowed in (False, True):
        (site,) = _check(ByColour(), plain("road")).judge(_sites((9, 0)), FLAT, allow_risky=allowed)
        assert site.accepted is allowed and site.class_predicted == "road"


def test_a_closer_look_counts_as_much_as_the_first() -> None:
    """Lawn from above, water from below: neither, so it is refused; lawn twice stays lawn."""
    check = _check(ByColour(), plain("water"))
    before = SitePlace(_chances(lawn=0.99), True)
    place = check.look_again(before, np.zeros(3), FLAT, 2.0)
    assert place is not None
    water = D_LAND.index("water")
    expected = 0.5 * (_chances(lawn=0.99) + _chances(water=SURE))
    assert place.chances[water] == pytest.approx(expected[water])
    assert check.refusal(place, False) is not None
    again = _check(ByColour()).look_again(before, np.array([9.0, 0, 0]), FLAT, 2.0)
    assert again is not None and check.refusal(again, False) is None


def test_an_emergency_takes_the_least_bad() -> None:
    sites = [dataclasses.replace(site, accepted=False, reason="refused: x")
             for site in _sites((0, 0), (1, 0), (2, 0))]  # fmt: skip
    named = [dataclasses.replace(site, class_predicted=name)
             for site, name in zip(sites, ("water", None, "road"), strict=True)]  # fmt: skip
    chosen = least_bad(named)
    assert chosen[0].class_predicted == "road" and chosen[0].reason == "the least bad: x"
    assert [site.accepted for site in chosen] == [True, False, False]
    assert least_bad(named[:2])[0].class_predicted is None
    assert least_bad(named[:1])[0].accepted and least_bad([]) == ()


# ------------------------------------------------------------------------------- what LIDAR knows


def test_lost_pulses_make_water_likelier_and_none_prove_nothing() -> None:
    doubtful = _chances(lawn=0.9, water=0.05)
    water = D_LAND.index("water")
    np.testing.assert_allclose(weighed(doubtful, 0.0, 900.0, False), doubtful)
    np.testing.assert_allclose(weighed(doubtful, 0.0, 0.0, False), doubtful)
    # 2 of 20 lost: 15^2 (0.85 / 0.99)^18
    ratio = 15.0**2 * (0.85 / 0.99) ** 18
    expected = 0.05 * ratio / (0.05 * ratio + 0.95)
    assert weighed(doubtful, 100.0, 900.0, False)[water] == pytest.approx(expected)
    assert weighed(doubtful, 300.0, 700.0, False)[water] > 0.99


def test_traffic_makes_a_road_of_a_doubtful_path() -> None:
    doubtful = _chances(path=0.85, road=0.1)
    found = weighed(doubtful, 0.0, 900.0, True)
    assert D_LAND[int(found.argmax())] == "road"
    assert found[D_LAND.index("road")] == pytest.approx(2.0 / 2.9)
    lawn = weighed(_chances(lawn=0.994), 0.0, 900.0, True)
    assert lawn[D_LAND.index("lawn")] > 0.95


def test_a_doubtful_site_over_lossy_ground_is_refused() -> None:
    """What passes by the picture alone is refused where a fifth of the pulses never came back."""
    grid = make_grid(np.zeros((200, 200)), origin=(-20.0, -20.0))
    grid.missing[:, 140:] = 10.0
    check = _check(ByColour(sure=0.95), plain("lawn"))
    dry, wet = check.judge(_sites((-9, 0), (12, 0)), view_of(grid))
    assert dry.accepted and not wet.accepted and wet.class_predicted == "water"


def test_traffic_is_looked_up_where_the_site_is() -> None:
    view = view_of(make_grid(np.zeros((200, 200)), origin=(-20.0, -20.0)))
    selection = select_sites(view, make_estimate(0, ABOVE), LandingParams(), footprint_radius_m=0.5)
    assert selection.costmap is not None
    driven = np.zeros_like(selection.allowed)
    driven[:, driven.shape[1] // 2 :] = True
    marked: Selection = dataclasses.replace(selection, driven=driven)
    check = _check(ByColour(sure=0.93), plain("lawn"))
    west, east = check.judge(_sites((-9, 0), (9, 0)), view, selection=marked)
    assert west.accepted and not east.accepted


def test_surfaces_that_were_refused_rank_lower() -> None:
    """Two surfaces with different echo: the one that a refused site lies on comes last."""
    grid = make_grid(np.zeros((200, 200)), origin=(-20.0, -20.0))
    grid.intensity[:, :100] = 90.0
    view, estimate = view_of(grid), make_estimate(0, ABOVE)
    for side in (-1.0, 1.0):
        refused = np.array([8.0 * side, 0.0, 0.0])
        sites = select_sites(
            view, estimate, LandingParams(), footprint_radius_m=0.5,
            avoid_odom=[refused], alike_odom=[refused],
        ).candidates  # fmt: skip
        assert sites[0].accepted and np.sign(sites[0].position_odom[0]) == -side


# ------------------------------------------------------------------------------------ the network


def test_the_network_of_a_file_says_what_it_sees(tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    from landing.recognition.in_flight import load_places

    limits = decision.Limits(least_probability=0.75, least_energy=8.0)
    path = write_colour_network(tmp_path / "network.onnx", limits=limits)
    places = load_places(path)
    assert (places.image_size, places.least_probability) == (16, 0.75)
    pictures = np.zeros((3, 16, 16, 3), np.uint8)
    pictures[0, ..., 2] = pictures[1, ..., 1] = 255
    opinion = places.look(pictures)
    assert [D_LAND[i] for i in opinion.chances.argmax(axis=1)[:2]] == ["water", "lawn"]
    assert opinion.familiar.tolist() == [True, True, False]  # black is like nothing it knows
    assert load_places(path) is places
    write_colour_network(path, limits=dataclasses.replace(limits, least_probability=0.5))
    assert load_places(path).least_probability == 0.5


def test_one_line_for_a_network_that_cannot_fly(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("onnx")
    from experiments import cli

    cut = write_colour_network(tmp_path / "cut.onnx")
    cut.write_bytes(cut.read_bytes()[:-40])
    scene = write_colour_network(tmp_path / "scene.onnx", labels="d_scene")
    bare = write_colour_network(tmp_path / "bare.onnx")
    weights.checksum_file(bare).unlink()
    for name, words in (
        (cut, "is cut short or changed"),
        (scene, "a flight needs one trained with --labels d_land"),
        (bare, "cannot be trusted"),
        (tmp_path / "none.onnx", "does not exist"),
    ):
        out = tmp_path / "run"
        arguments = ["land", "flat", "--out", str(out), "--quiet"]
        assert cli.main([*arguments, "--set", f"landing.place_recognition={name}"]) == 2
        told = capsys.readouterr().err
        assert words in told and told.count("\n") == 1 and not out.exists()


def test_off_and_what_comes_with_the_project(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("onnx")
    from experiments.build import build_places
    from experiments.config import load_config
    from landing.recognition import in_flight

    shipped = tmp_path / "shipped.onnx"
    monkeypatch.setattr(in_flight, "SHIPPED", shipped)
    assert build_places(load_config()) is None
    write_colour_network(shipped)
    found = build_places(load_config())
    assert found is not None and found.description()["network"] == "by colour"
    for override in ("landing.place_recognition=off", "landing.survey_only=true"):
        assert build_places(load_config(None, [override])) is None
    for override in ("landing.place_patch_m=0.0", "landing.place_least_probability=1.5"):
        with pytest.raises(ValueError, match=override.partition("=")[0]):
            build_places(load_config(None, [override]))


def test_who_counts_by_class() -> None:
    from experiments.cli_base import is_good
    from experiments.flight import class_counts

    assert class_counts(LandingParams())
    assert class_counts(LandingParams(site_xy_m=(1.0, 2.0)))
    for changes in (
        {"allow_risky": True},
        {"emergency": "battery"},
        {"site_xy_m": (1.0, 2.0), "check_site": False},
    ):
        assert not class_counts(LandingParams(**changes))  # type: ignore[arg-type]
    wet = {"safe_geometry": True, "safe": False}
    for judged_on, good in (("geometry", True), ("geometry and class", False)):
        assert is_good({"outcome": "LANDED", "landing": wet | {"judged_on": judged_on}}) is good
