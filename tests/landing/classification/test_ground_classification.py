"""Ground classification in flight: decision limits, LIDAR evidence, refusals."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from touchdown.experiments.flight.run import class_counts
from touchdown.experiments.flight.wiring import build_classifier
from touchdown.experiments.io.result_parts import Landing
from touchdown.experiments.io.results import is_success
from touchdown.landing.api import Candidate, LandingParams, SemanticMapParams
from touchdown.landing.classification import decision, onboard, weights
from touchdown.landing.classification.labels import D_LAND
from touchdown.landing.classification.site_check import (
    SiteClass,
    SiteClassCheck,
    fuse_lidar_evidence,
    least_bad,
)
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array

from support.command import Says
from support.ground_class_support import (
    ByColour,
    chances,
    photograph,
    plain,
    site_at,
    small_rig,
    west_is_water,
    write_colour_network,
)
from support.landing_support import make_estimate, make_grid, make_obs, select, view_of
from support.worlds import load_ideal_config as load_config

ABOVE = Pose(np.eye(3), np.array([0.0, 0.0, 20.0]))
SURE = 0.97


def _scores(*rows: Array) -> NDArray[np.float32]:
    return np.log(np.array(rows)).astype(np.float32)


def test_energy_is_the_logarithm_of_the_sum_of_exponentials() -> None:
    scores = np.array([[0.0, np.log(3.0)], [500.0, 500.0]], np.float32)
    np.testing.assert_allclose(
        decision.energies(scores), [np.log(4.0), 500.0 + np.log(2.0)], rtol=1e-6
    )


def test_safe_classes_count_together() -> None:
    """Half lawn, half field is safe ground all the same; half lawn, half water is not."""
    scores = _scores(chances(lawn=0.5, field=0.46), chances(lawn=0.55, water=0.44))
    limits = decision.Limits(min_probability=0.9)
    assert decision.accepted(scores, limits).tolist() == [True, False]
    strange = dataclasses.replace(limits, min_energy=1.0)
    assert not decision.accepted(scores, strange).any()


def test_limits_are_set_by_an_interval_of_the_share_of_unsafe_images() -> None:
    """None of 299 shows, with 95 %, that less than a hundredth passes: 0.99^299 = 0.0496. 800
    images of water, claimed to be lawn with 0.5 to 0.9: three of them may pass, since the binomial
    chance of at most three of 800 at 0.01 is 0.041, and of at most four 0.098."""
    assert decision.upper_bound(0, 299) == pytest.approx(1.0 - 0.05 ** (1.0 / 299.0))
    allowed = [decision.allowed_mistakes(n, 0.01, 0.95) for n in (298, 299, 472, 473, 800)]
    assert allowed == [-1, 0, 0, 1, 3]
    claims = np.linspace(0.5, 0.9, 800)
    rows = [chances(lawn=float(claim)) for claim in claims]
    labels = np.full(800, D_LAND.index("water"))
    limits = decision.fitted_limits(_scores(*rows), labels)
    taken = decision.accepted(_scores(*rows), limits)
    assert np.flatnonzero(taken).tolist() == [797, 798, 799]
    found = decision.decision_summary(_scores(*rows), labels, limits)
    assert (found["unsafe"], found["unsafe_taken_for_safe"], found["safe"]) == (800, 3, 0)
    # above 0.55, since a third of the rest is of the other safe classes: 0.55 + 0.15 = 0.7
    assert (found["unsafe_unknown"], found["safe_unknown"]) == (int((claims > 0.55).sum()) - 3, 0)
    assert decision.is_unsafe(np.array([-1, 0, 5])).tolist() == [True, False, True]
    easy = decision.fitted_limits(_scores(chances(lawn=SURE)), np.array([D_LAND.index("lawn")]))
    assert easy.min_probability == decision.MIN


def _sites(*xy: tuple[float, float]) -> list[Candidate]:
    return [site_at(x, y) for x, y in xy]


FLAT = view_of(make_grid(np.zeros((200, 200)), origin=(-20.0, -20.0)))


def _check(classifier: Any, paint: Any = west_is_water, **params: Any) -> SiteClassCheck:
    rig = small_rig()
    check = SiteClassCheck(
        classifier, rig, LandingParams(**{"semantics": SemanticMapParams(squares=0)} | params)
    )
    obs = make_obs(
        600, images=(photograph(rig, Pose(np.eye(3), np.array([0, 0, 40.0])), paint, 1.0),)
    )
    check.update(obs, make_estimate(600, Pose(np.eye(3), np.array([0, 0, 40.0]))), FLAT)
    return check


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


def test_refused_sites_are_not_classified() -> None:
    classifier = ByColour()
    bad, good = _sites((-9, 0), (9, 0))
    bad = dataclasses.replace(bad, accepted=False, reason="refused: a step")
    judged = _check(classifier).judge([bad, good], FLAT)
    assert classifier.batches == [1] and judged[0] is bad and judged[1].accepted


@pytest.mark.parametrize(("classifier", "words"), [
    (ByColour(sure=0.6), "unsure what it is: lawn with probability 0.60"),
    (ByColour(in_distribution=False), "it looks like no known ground"),
])  # fmt: skip
def test_uncertain_predictions_are_refused(classifier: ByColour, words: str) -> None:
    (site,) = _check(classifier).judge(_sites((9, 0)), FLAT)
    assert not site.accepted and words in site.reason and site.class_predicted == "lawn"


def test_configuration_overrides_the_limit() -> None:
    (site,) = _check(ByColour(sure=0.6), classifier_min_probability=0.55).judge(
        _sites((9, 0)), FLAT
    )
    assert site.accepted
    (site,) = _check(ByColour(), classifier_min_probability=0.999).judge(_sites((9, 0)), FLAT)
    assert "(at least 1.00)" in site.reason and not site.accepted


@pytest.mark.parametrize(("sure", "known", "policy", "accepted"), [
    (0.8, True, "refuse", False), (0.8, True, "geometry", True), (0.8, False, "geometry", True),
    (0.5, True, "geometry", False),
])  # fmt: skip
def test_unknown_ground_is_landed_on_by_its_geometry_alone_if_wished(
    sure: float, known: bool, policy: str, accepted: bool
) -> None:
    """Where classes that are not allowed have less than 0.3 together (of the 0.2 and 0.5 that
    `lawn` leaves, a third is of `field` and `path`); what looks like water is refused by any."""
    check = _check(ByColour(sure, known), unknown_ground=policy)
    assert check.judge(_sites((9, 0)), FLAT)[0].accepted is accepted
    check = _check(ByColour(0.8), plain("water"), unknown_ground="geometry")
    assert not check.judge(_sites((9, 0)), FLAT)[0].accepted


def test_site_without_an_image_is_refused() -> None:
    classifier = ByColour()
    (site,) = _check(classifier).judge(_sites((60, 0)), FLAT)
    assert site.reason == "refused: no image shows what kind of ground it is"
    assert classifier.batches == [] and site.class_predicted is None


def test_roads_are_accepted_only_where_they_are_allowed() -> None:
    for allowed in (False, True):
        (site,) = _check(ByColour(), plain("road")).judge(_sites((9, 0)), FLAT, allow_risky=allowed)
        assert site.accepted is allowed and site.class_predicted == "road"
    for name in ("road", "lawn"):
        policy = _check(ByColour(), plain(name), allowed_classes=("road", "field"))
        assert policy.judge(_sites((9, 0)), FLAT)[0].accepted is (name == "road")


def test_second_look_has_the_weight_of_the_first() -> None:
    """Lawn from above, water from below: neither, so it is refused; lawn twice stays lawn."""
    check = _check(ByColour(), plain("water"))
    before = SiteClass(chances(lawn=0.99), True)
    site_class = check.reclassify(before, np.zeros(3), FLAT, 2.0)
    assert site_class is not None
    water = D_LAND.index("water")
    expected = 0.5 * (chances(lawn=0.99) + chances(water=SURE))
    assert site_class.probabilities[water] == pytest.approx(expected[water])
    assert check.refusal(site_class, False) is not None
    again = _check(ByColour()).reclassify(before, np.array([9.0, 0, 0]), FLAT, 2.0)
    assert again is not None and check.refusal(again, False) is None


def test_a_blurred_closer_look_adds_little() -> None:
    """Painted ground without fine detail: unsure and strange from closer, it keeps the first
    prediction; with detail it halves it. Smooth water refuses all the same."""
    before = SiteClass(chances(lawn=0.99), True)
    unsure = ByColour(0.6, in_distribution=False)
    grain = np.random.default_rng(0).normal(0.0, 60.0, (4000,))

    def grainy(x: Array, y: Array) -> Array:
        return plain("lawn")(x, y) + grain[(97 * x + 61 * y).astype(int)][..., None]

    for paint, fraction, known in ((plain("lawn"), 0.0, True), (grainy, 0.5, False)):
        unsure.image_size = 64
        seen = _check(unsure, paint).reclassify(before, np.zeros(3), FLAT, 2.0)
        assert seen is not None and seen.in_distribution is known
        lawn = (1.0 - fraction) * 0.99 + fraction * 0.6
        assert seen.probabilities[D_LAND.index("lawn")] == pytest.approx(lawn, abs=0.03)
    water = ByColour(0.97)
    water.image_size = 64
    smooth = _check(water, plain("water")).reclassify(before, np.zeros(3), FLAT, 2.0)
    assert smooth is not None and smooth.probabilities[D_LAND.index("water")] > 0.45


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


def test_missing_pulses_raise_the_probability_of_water_and_their_absence_does_not_lower_it() -> (
    None
):
    doubtful = chances(lawn=0.9, water=0.05)
    water = D_LAND.index("water")
    np.testing.assert_allclose(fuse_lidar_evidence(doubtful, 0.0, 900.0, False), doubtful)
    np.testing.assert_allclose(fuse_lidar_evidence(doubtful, 0.0, 0.0, False), doubtful)
    # 2 of 20 lost: 15^2 (0.85 / 0.99)^18
    ratio = 15.0**2 * (0.85 / 0.99) ** 18
    expected = 0.05 * ratio / (0.05 * ratio + 0.95)
    assert fuse_lidar_evidence(doubtful, 100.0, 900.0, False)[water] == pytest.approx(expected)
    assert fuse_lidar_evidence(doubtful, 300.0, 700.0, False)[water] > 0.99


def test_traffic_turns_an_uncertain_path_into_a_road() -> None:
    doubtful = chances(path=0.85, road=0.1)
    found = fuse_lidar_evidence(doubtful, 0.0, 900.0, True)
    assert D_LAND[int(found.argmax())] == "road"
    assert found[D_LAND.index("road")] == pytest.approx(2.0 / 2.9)
    lawn = fuse_lidar_evidence(chances(lawn=0.994), 0.0, 900.0, True)
    assert lawn[D_LAND.index("lawn")] > 0.95


def test_uncertain_site_with_missing_pulses_is_refused() -> None:
    """What passes by the image alone is refused where a fifth of the pulses never came back."""
    grid = make_grid(np.zeros((200, 200)), origin=(-20.0, -20.0))
    grid.missing[:, 140:] = 10.0
    check = _check(ByColour(sure=0.95), plain("lawn"))
    dry, wet = check.judge(_sites((-9, 0), (12, 0)), view_of(grid))
    assert dry.accepted and not wet.accepted and wet.class_predicted == "water"


def _snowy(level: float = 125.0) -> Any:
    grid = make_grid(np.zeros((200, 200)), origin=(-20.0, -20.0))
    grid.intensity[:] = level
    return grid


def test_wide_ground_as_bright_as_snow_is_a_field() -> None:
    """An image of snow looks like a roof or a road to a network that never saw any."""
    site = _sites((-9, 0))
    for level, accepted in ((125.0, True), (95.0, True), (70.0, False)):
        (judged,) = _check(ByColour(), plain("road")).judge(site, view_of(_snowy(level)))
        assert judged.accepted is accepted, judged.reason
    (judged,) = _check(ByColour(), plain("road")).judge(site, view_of(_snowy()))
    assert judged.class_predicted == "field"
    assert judged.class_probability == pytest.approx(1.0 - 0.03 / 6.0)


def test_ice_that_the_image_shows_stays_water() -> None:
    (judged,) = _check(ByColour(), plain("water")).judge(_sites((-9, 0)), view_of(_snowy()))
    assert not judged.accepted and judged.class_predicted == "water"


def test_bright_things_that_are_small_or_end_in_steps_are_no_snow() -> None:
    sites = _sites((0, 0))
    patch, roof, mixed = _snowy(60.0), _snowy(60.0), _snowy()
    patch.intensity[70:130, 70:130] = 125.0  # 12 x 12 m of fleece
    roof.intensity[:] = 125.0  # a hall of 16 x 20 m under snow
    for layer in (roof.height_m, roof.min_height_m, roof.max_height_m):
        layer[50:150, 70:150] += 6.0
    mixed.intensity[100:, :] = 60.0  # half of the square is something else
    for grid in (patch, roof, mixed):
        (judged,) = _check(ByColour(), plain("road")).judge(sites, view_of(grid))
        assert not judged.accepted
    (beside,) = _check(ByColour(), plain("road")).judge(_sites((-11, 0)), view_of(roof))
    assert beside.accepted


def test_in_the_dark_the_class_is_left_to_the_second_look() -> None:
    def black(x: Array, y: Array) -> Array:
        return np.zeros((*x.shape, 3))

    (judged,) = _check(ByColour(), black).judge(_sites((-9, 0)), FLAT)
    assert not judged.accepted  # without noise the image is a defect, not a night
    rig = small_rig()
    pose = Pose(np.eye(3), np.array([0, 0, 40.0]))
    night = photograph(rig, pose, black, 1.0, noise=10.0)
    for site_recheck in (True, False):
        check = SiteClassCheck(ByColour(), rig, LandingParams(site_recheck=site_recheck))
        check.update(make_obs(600, images=(night,)), make_estimate(600, pose), FLAT)
        (judged,) = check.judge(_sites((-9, 0)), FLAT)
        assert judged.accepted is site_recheck and judged.class_predicted is None
        assert ("too dark" in judged.reason) is site_recheck
    assert check.refusal(None, False) is not None  # and from close by it must be seen


def test_refused_surfaces_rank_lower() -> None:
    """Two surfaces with different echo: the one that a refused site lies on comes last."""
    grid = make_grid(np.zeros((200, 200)), origin=(-20.0, -20.0))
    grid.intensity[:, :100] = 90.0
    view, estimate = view_of(grid), make_estimate(0, ABOVE)
    for side in (-1.0, 1.0):
        refused = np.array([8.0 * side, 0.0, 0.0])
        sites = select(
            view, estimate, LandingParams(), avoid_odom=[refused], unsafe_ground_odom=[refused]
        ).candidates
        assert sites[0].accepted and np.sign(sites[0].position_odom[0]) == -side


def test_network_of_a_file_classifies(tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    limits = decision.Limits(min_probability=0.75, min_energy=8.0)
    path = write_colour_network(tmp_path / "network.onnx", limits=limits)
    classifier = onboard.load_onboard_classifier(path)
    assert (classifier.image_size, classifier.min_probability) == (16, 0.75)
    images = np.zeros((3, 16, 16, 3), np.uint8)
    images[0, ..., 2] = images[1, ..., 1] = 255
    prediction = classifier.classify(images)
    assert [D_LAND[i] for i in prediction.probabilities.argmax(axis=1)[:2]] == ["water", "lawn"]
    assert prediction.in_distribution.tolist() == [
        True, True, False,
    ]  # black is like nothing it knows  # fmt: skip
    assert onboard.load_onboard_classifier(path) is classifier
    write_colour_network(path, limits=dataclasses.replace(limits, min_probability=0.5))
    assert onboard.load_onboard_classifier(path).min_probability == 0.5


def test_unusable_network_is_refused_in_one_line(tmp_path: Path, says: Says) -> None:
    pytest.importorskip("onnx")
    cut = write_colour_network(tmp_path / "cut.onnx")
    cut.write_bytes(cut.read_bytes()[:-40])
    scene = write_colour_network(tmp_path / "scene.onnx", labels="d_scene")
    bare = write_colour_network(tmp_path / "bare.onnx")
    weights.checksum_file(bare).unlink()
    for name, words in (
        (cut, "is truncated or changed"),
        (scene, "a flight needs a network trained with --labels d_land"),
        (bare, "is not loaded without it"),
        (tmp_path / "none.onnx", "does not exist"),
    ):
        out = tmp_path / "run"
        arguments = ["land", "flat", "--out", out, "--quiet"]
        output = says(2, *arguments, "--set", f"landing.classifier={name}").err
        assert words in output and output.count("\n") == 1 and not out.exists()


def test_classifier_off_and_auto(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("onnx")
    shipped = tmp_path / "shipped.onnx"
    monkeypatch.setattr(onboard, "SHIPPED", shipped)
    assert build_classifier(load_config()) is None
    write_colour_network(shipped)
    found = build_classifier(load_config())
    assert found is not None and found.description()["network"] == "by colour"
    for override in ("landing.classifier=off", "landing.survey_only=true", "landing.risk.gates=[]"):
        assert build_classifier(load_config(None, [override])) is None
    for override in ("landing.classifier_patch_m=0.0", "landing.classifier_min_probability=1.5"):
        with pytest.raises(ValueError, match=override.partition("=")[0]):
            build_classifier(load_config(None, [override]))


def test_landings_judged_by_class() -> None:
    assert class_counts(LandingParams()) and class_counts(LandingParams(site_xy_m=(1.0, 2.0)))
    for changes in (
        {"allow_risky": True},
        {"allowed_classes": ("lawn", "road")},
        {"emergency": "battery"},
        {"site_xy_m": (1.0, 2.0), "check_site": False},
    ):
        assert not class_counts(LandingParams(**changes))  # type: ignore[arg-type]
    wet = {"safe_geometry": True, "safe": False}
    for judged_on, success in (("geometry", True), ("geometry and class", False)):
        landing = Landing(judged_on=judged_on, **wet)
        assert is_success("LANDED", landing.ground_safe) is success


def test_traffic_is_read_at_the_site() -> None:
    view = view_of(make_grid(np.zeros((200, 200)), origin=(-20.0, -20.0)))
    chosen = select(view, make_estimate(0, ABOVE), LandingParams())
    chosen.traffic_zone[:, chosen.traffic_zone.shape[1] // 2 :] = True
    check = _check(ByColour(sure=0.93), plain("lawn"))
    west, east = check.judge(_sites((-9, 0), (9, 0)), view, selection=chosen)
    assert west.accepted and not east.accepted
