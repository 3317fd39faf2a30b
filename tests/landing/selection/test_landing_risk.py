"""The probability of a safe touchdown, the stages beside their library version, Quick Shift beside
scikit-image's."""

import numpy as np
import pytest

from touchdown.experiments.benchmarks.selection.timing import (
    STAGES,
    reference_selection,
    staged_selection,
)
from touchdown.landing.api import LandingParams
from touchdown.landing.classification.scores import calibration
from touchdown.landing.selection import probability as risk
from touchdown.landing.selection.probability import NAMES, RiskFeatures

from support.landing_support import ABOVE, make_grid, rising, select, view_of

PARAMS = LandingParams()


def features_at(height: np.ndarray, spot: tuple[int, int]) -> dict[str, float]:
    found = risk.features_of(view_of(make_grid(height, sigma=0.0)), ABOVE, PARAMS)
    return dict(zip(NAMES, map(float, found.values[spot]), strict=True))


def test_features_are_shares_of_the_limits() -> None:
    slope = features_at(rising(3.0), (40, 40))
    assert slope["slope"] == pytest.approx(3.0 / 5.0, abs=1e-3)
    # Three cells of 0.2 m: a rise of 0.4 m times tan 3 deg.
    assert slope["step"] == pytest.approx(0.4 * np.tan(np.deg2rad(3.0)) / 0.10, abs=1e-3)
    assert slope["confinement"] == 0.0
    flat = np.zeros((80, 80))
    flat[:, 46] = 0.05
    assert features_at(flat, (40, 39))["step"] == 0.0  # the step's cell is 1.2 m away
    assert features_at(flat, (40, 40))["step"] == pytest.approx(0.5)


def test_confinement_counts_the_clearance_beyond_the_footprint() -> None:
    wall = np.zeros((80, 80))
    wall[:, 60:] = 2.0
    here = features_at(wall, (40, 50))
    away = features_at(wall, (40, 35))
    assert away["confinement"] == 0.0
    assert 0.5 < here["confinement"] < 1.0
    assert here["neighbour"] == pytest.approx(0.0)
    assert features_at(wall, (40, 53))["neighbour"] == pytest.approx(2.0)


def test_logistic_model_by_hand() -> None:
    values = np.array([[[0.5, 0.9, 1.4, 0.0, 0.2, 0.1, 0.3, 0.4, 0.6, 0.7, 0.8, 0.9]]], np.float32)
    weights = (3.0, -1.0, -2.0, -1.0, -1.0, -0.5, -4.0, -0.1, -0.2, -0.3, -0.4, -0.6, -0.7, -5.0)
    odds = 3.0 - 0.5 - 1.8 - 1.4 - 0.1 - 0.4 - 0.03 - 0.08
    odds += -0.18 - 0.28 - 0.48 - 0.63 - 5.0 * (1.4 - 1.2)
    expected = 1.0 / (1.0 + np.exp(-odds))
    seen = RiskFeatures(values=values, open=np.array([[True]]))
    assert risk.probability(seen, weights)[0, 0] == pytest.approx(expected, rel=1e-5)
    assert risk.predict(values[0], weights)[0] == pytest.approx(expected, rel=1e-5)
    shut = RiskFeatures(values=values, open=np.array([[False]]))
    assert risk.probability(shut, weights)[0, 0] == 0.0
    with pytest.raises(ValueError, match="risk_weights needs 14 numbers"):
        risk.predict(values[0], (1.0, 2.0))


def test_fit_finds_calibrated_probabilities_and_keeps_signs() -> None:
    rng = np.random.default_rng(4)
    values = rng.uniform(0.0, 1.5, (20000, len(NAMES))).astype(np.float32)
    weights = (8.0, -1.0, -2.0, *[-0.2] * 3, -3.0, -0.2, -0.2, -1.0, -1.0, -1.0, -0.2, -4.0)
    safe = rng.uniform(size=20000) < risk.predict(values, weights)
    found = risk.fit_weights(values, safe)
    assert all(weight <= -0.2 for weight in found[1:]) and found[-1] <= -3.0
    error, rows = calibration(risk.predict(values, found), safe)
    assert error < 0.01
    assert sum(number for _, _, number in rows) == 20000


def test_all_selectors_land_on_the_good_half_and_an_emergency_takes_the_least_bad() -> None:
    rng = np.random.default_rng(2)
    half = np.zeros((80, 80))
    half[:, :40] += rng.uniform(0.0, 0.6, (80, 40))
    for params in (
        PARAMS, LandingParams(selector="zou2024"),
        LandingParams(selector="zou2024", flatness_form="literal"),
    ):  # fmt: skip
        view = view_of(make_grid(half))
        site, *others = select(view, ABOVE, params).candidates
        assert site.accepted and site.reason.startswith("landable")
        assert all(o.accepted or o.reason.startswith("refused") for o in others)
        assert site.position_odom[0] > 9.0
    steep = view_of(make_grid(rising(7.0)))
    refused = select(steep, ABOVE, PARAMS)
    assert not any(site.accepted for site in refused.candidates)
    forced = select(steep, ABOVE, PARAMS, emergency=True)
    assert forced.candidates[0].accepted
    assert "the least bad" in forced.candidates[0].reason


def test_stages_agree_with_open3d_scipy_and_scikit_image() -> None:
    pytest.importorskip("skimage")
    rng = np.random.default_rng(5)
    y, x = np.mgrid[0:120, 0:100] * 0.2
    height = 0.05 * np.sin(x) + np.where(x > 14.0, 0.3 * (x - 14.0), 0.0)
    height += np.where(y > 18.0, rng.uniform(0.0, 0.5, y.shape), 0.0)
    grid = make_grid(height)
    grid.rgb[:, 30:] = 220.0
    place = np.array([8.0, 8.0, 30.0])
    ours = staged_selection(grid, place, PARAMS, 0.42)
    theirs = reference_selection(grid, place, PARAMS, 0.42)
    assert tuple(ours.seconds) == tuple(theirs.seconds) == STAGES
    both = np.isfinite(ours.total) & np.isfinite(theirs.total)
    assert both.mean() > 0.9
    assert np.abs(ours.total - theirs.total)[both].mean() < 0.03
    assert np.corrcoef(ours.total[both], theirs.total[both])[0, 1] > 0.97
    best = [s.modes[np.argmax(s.total[tuple(s.modes.T)])] for s in (ours, theirs)]
    assert np.hypot(*(best[0] - best[1])) * 0.2 < 1.0


def test_calibration_error_by_hand() -> None:
    error, rows = calibration(
        np.array([0.15, 0.15, 0.95, 0.95], np.float32), np.array([True, False, True, True])
    )
    assert error == pytest.approx(0.5 * 0.35 + 0.5 * 0.05, abs=1e-6)
    assert [(fraction, number) for _, fraction, number in rows] == [(0.5, 2), (1.0, 2)]
