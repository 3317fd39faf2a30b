"""Scan patterns against the figures of recorded sensors and data sheets."""

import numpy as np
import pytest
from numpy.typing import NDArray

from touchdown.sim.lidar.patterns import (
    AVIA,
    HORIZON,
    MID360,
    PATTERNS,
    RisleyPattern,
    ScanPattern,
)
from touchdown.sim.typing import Array


def angles_deg(beams: NDArray[np.float32]) -> tuple[Array, Array]:
    """Azimuth along the long axis and elevation along the short one."""
    x, y, z = beams.astype(np.float64).T
    return np.rad2deg(np.arctan2(x, z)), np.rad2deg(np.arcsin(y))


def coverage(
    scan_pattern: ScanPattern, start: int, seconds: float, cells: tuple[int, int]
) -> float:
    """Percentage of the cells of the field of view that are hit."""
    width, height = scan_pattern.field_of_view_deg
    beams = scan_pattern.directions(start, int(seconds * scan_pattern.point_rate_hz))
    limits = [[-width / 2, width / 2], [-height / 2, height / 2]]
    seen, _, _ = np.histogram2d(*angles_deg(beams), bins=cells, range=limits)
    return float(100.0 * np.mean(seen > 0))


@pytest.mark.parametrize(
    ("seconds", "recorded", "model"),
    [(0.1, 61.0, 60.0), (0.2, 83.0, 82.0), (0.3, 91.0, 90.0), (0.5, 95.0, 95.0)],
)
def test_horizon_covers_its_field_of_view(seconds: float, recorded: float, model: float) -> None:
    """Cells of 0.31 degrees."""
    starts = (0, 1_234_567, 50_000_000)
    fraction = np.mean([coverage(HORIZON, start, seconds, (264, 81)) for start in starts])
    assert fraction == pytest.approx(model, abs=1.0)
    assert fraction == pytest.approx(recorded, abs=3.0)


def test_avia_rosette_covers_its_field_of_view() -> None:
    """Cells of 0.5 degrees; four seconds of recordings cover 50, 77 and 83 % of the rectangle (the
    rosette leaves its corners out)."""
    for seconds, recorded in ((0.1, 49.8), (0.3, 77.0), (1.0, 83.3)):
        assert coverage(AVIA, 0, seconds, (140, 154)) == pytest.approx(recorded, abs=1.5)
    azimuth, elevation = angles_deg(AVIA.directions(0, 480_000))
    assert np.ptp(azimuth) == pytest.approx(70.4, abs=0.3)
    assert np.ptp(elevation) == pytest.approx(77.2, abs=0.5)


def test_mid360_looks_all_round() -> None:
    """One degree cells of azimuth and elevation; recordings fill 63, 93 and 97 %."""
    for seconds, recorded in ((0.1, 63.0), (0.3, 93.1), (1.0, 97.0)):
        x, y, z = MID360.directions(0, int(seconds * 200_000)).astype(np.float64).T
        elevation = np.rad2deg(np.arcsin(z))
        seen, _, _ = np.histogram2d(
            np.rad2deg(np.arctan2(y, x)), elevation, bins=(360, 59), range=[[-180, 180], [-7, 52]]
        )
        assert 100.0 * np.mean(seen > 0) == pytest.approx(recorded, abs=3.0)
    assert elevation.min() == pytest.approx(-7.0, abs=0.5)
    assert elevation.max() == pytest.approx(52.0, abs=2.0)


@pytest.mark.parametrize("name", PATTERNS)
def test_pattern_is_a_function_of_the_pulse_index(name: str) -> None:
    directions = PATTERNS[name].directions
    whole = directions(1_000_000, 900)
    np.testing.assert_array_equal(directions(1_000_123, 400), whole[123:523])
    np.testing.assert_allclose(np.linalg.norm(whole, axis=1), 1.0, atol=1e-6)
    assert directions(7, 0).shape == (0, 3)
    with pytest.raises(ValueError, match="pulse index -1"):
        directions(-1, 5)


@pytest.mark.parametrize("name", ["horizon", "avia", "mid360"])
def test_pattern_does_not_repeat(name: str) -> None:
    """Scans of a tenth of a second, long after one another, share few of their cells' counts."""
    scan_pattern = PATTERNS[name]
    count = scan_pattern.point_rate_hz // 10
    first = scan_pattern.directions(0, count)
    for tenth in (1, 2, 10, 600):
        other = scan_pattern.directions(tenth * count, count)
        apart = np.rad2deg(np.linalg.norm(first - other, axis=1))
        assert np.median(apart) > 0.05


@pytest.mark.parametrize(("pattern", "prism_hz"), [(HORIZON, -9.9351), (AVIA, 131.55003)])
def test_the_error_of_a_prism_turns_with_it(pattern: ScanPattern, prism_hz: float) -> None:
    """Beams near the boresight are off by the error, in the direction of the first prism."""
    assert isinstance(pattern.directions, RisleyPattern)
    nominal = pattern.directions(0, 240_000).astype(np.float64)
    fired = pattern.directions.erring(np.radians(0.1), 0.7)(0, 240_000).astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(fired, axis=1), 1.0, atol=1e-6)
    off = (fired - nominal)[:, :2]
    size = np.degrees(np.linalg.norm(off, axis=1))
    assert np.median(size) == pytest.approx(0.1, rel=0.25) and size.max() < 0.2
    times = np.arange(240_000) / 240_000
    apart = np.unwrap(np.arctan2(off[:, 1], off[:, 0])) - 2.0 * np.pi * prism_hz * times
    assert np.ptp(apart) < np.pi / 2
