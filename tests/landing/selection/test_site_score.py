"""The terms of a site's value, the order of the sites, and the rules that refuse them."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from touchdown.landing.api import (
    Candidate,
    LandingParams,
    ScoreTerm,
    SelectorParams,
    SiteRule,
    TermName,
    Zou2024SelectorParams,
)
from touchdown.landing.selection.clustering import kernel_density
from touchdown.landing.selection.ranking import ranked, why_chosen
from touchdown.landing.selection.selector import check_site
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array

from support.landing_support import ABOVE, make_estimate, make_grid, rising, select, view_of

FAR = make_estimate(0, Pose(np.eye(3), np.array([-30.0, 8.0, 30.0])))
SIDE = 160


def _ground(slope_deg: float = 0.0) -> Array:
    """32 x 32 m that rises to the east."""
    return rising(slope_deg, SIDE)


def _sites(grid: Any, seen: dict[str, Any] | None = None, **params: Any) -> list[Candidate]:
    return list(select(view_of(grid), ABOVE, LandingParams(**params), **(seen or {})).candidates)


def _traffic() -> Any:
    """Level ground, dark to the LIDAR west of x = 8, with motion at x = 1."""
    grid = make_grid(_ground())
    grid.intensity[:, :40] = 14.0
    grid.intensity[:, 40:] = 46.0
    grid.height_std_m[30:50, 2:10] = 0.5
    grid.max_height_m[30:50, 2:10] = 1.5
    return grid


def _by_name(site: Candidate) -> dict[str, ScoreTerm]:
    return {term.name: term for term in site.terms}


@pytest.mark.parametrize("selector", ["risk", "zou2024"])
def test_terms_add_up_to_the_value_and_the_value_ranks(selector: str) -> None:
    half = _ground()
    half[:, :80] += np.random.default_rng(2).uniform(0.0, 0.6, (SIDE, 80))
    sites = _sites(make_grid(half), selector=selector)
    known = [site for site in sites if np.isfinite(site.value)]
    assert len(known) > 3
    for site in known:
        assert sum(term.value for term in site.terms) == pytest.approx(site.value, abs=1e-6)
    for accepted in (True, False):
        values = [site.value for site in known if site.accepted is accepted]
        assert values and values == sorted(values, reverse=True)
    rules = [site.rule for site in sites if site.accepted]
    assert rules == ["highest_value", *["lower_value"] * (len(rules) - 1)]


def test_terms_of_risk_by_hand() -> None:
    """Ground of 2 of at most 5 degrees; the vehicle west of the map, which ends around it."""
    view, params = view_of(make_grid(_ground(2.0), sigma=0.0)), LandingParams()
    site = select(view, FAR, params).candidates[0]
    terms = _by_name(site)
    assert list(terms) == [
        "probability",
        "distance",
        "clearance",
        "slope",
        "traffic",
        "plants",
        "ground",
    ]
    assert terms["probability"].value == pytest.approx(site.safe_probability, abs=1e-7)
    assert terms["slope"].value == pytest.approx(-0.2 * 2.0 / 5.0, abs=1e-3)
    assert (terms["slope"].quantity, terms["slope"].unit) == (pytest.approx(2.0, abs=0.02), "deg")
    clearance = terms["clearance"]
    assert clearance.quantity == pytest.approx(site.clearance_m) and clearance.unit == "m"
    assert clearance.value == pytest.approx(0.1 * min(site.clearance_m, 3.0) / 3.0, abs=1e-6)
    away = np.linalg.norm(site.position_odom[:2] - [-30.0, 8.0])
    assert terms["distance"].quantity == pytest.approx(away, abs=1e-4)
    along = (np.arange(SIDE) + 0.5) * 0.2
    horizontal = np.hypot(along + 30.0, (along - 8.0)[:, None])
    metres = np.hypot(horizontal, _ground(2.0) - 30.0)
    here = np.linalg.norm(site.position_odom - [-30.0, 8.0, 30.0])
    fraction = (here - metres.min()) / (metres.max() - metres.min())
    assert terms["distance"].value == pytest.approx(-0.05 * fraction, abs=1e-3)
    assert terms["traffic"].value == terms["plants"].value == terms["ground"].value == 0.0
    assert site.step_m == pytest.approx(np.tan(np.deg2rad(2.0)) * 0.4, abs=2e-3)


def test_zou2024_is_c_sum_and_its_candidates_are_the_modes() -> None:
    """Eqs. 13 to 19: traffic, plants and room change nothing."""
    grid = _traffic()
    grid.max_height_m[:] = np.maximum(grid.max_height_m, grid.min_height_m + 0.25)
    for gates in (("geometry", "reach", "class"), ("reach", "class")):
        params = LandingParams(selector="zou2024", zou2024=Zou2024SelectorParams(gates=gates))
        chosen = select(view_of(grid), FAR, params)
        view = chosen.costmap
        assert view is not None
        np.testing.assert_array_equal(view.value, view.total)
        assert [layer.name for layer in view.terms] == ["smoothness", "flatness", "distance"]
        layers = (view.smoothness, view.flatness, view.distance)
        for layer, weight, fraction in zip(view.terms, (0.3, 0.5, 0.2), layers, strict=True):
            np.testing.assert_allclose(layer.value, weight * fraction, atol=1e-6)
        sites = [site for site in chosen.candidates if site.accepted]
        assert sites
        density = kernel_density(view.value, 1.5 * 0.5 / 0.2)
        for site in sites:
            col, row = np.floor(site.position_odom[:2] / 0.2).astype(int)
            rivals = chosen.allowed & (chosen.cluster == chosen.cluster[row, col])
            assert density[row, col] == density[rivals].max()
            assert "geometry" in gates or [row, col] in chosen.modes.tolist()
        assert {site.cluster_bonus for site in sites} == {0.0}


def test_a_selector_without_gates_takes_any_ground() -> None:
    """The geometric gate, the gate of the probability and the reach, each switched off."""
    steep, away, shown = make_grid(_ground(7.0)), {"reach_m": 0.0}, {}
    for gates in ((), ("geometry",), ("probability",), ("reach",)):
        params = SelectorParams(gates=gates, terms=("probability", "slope"))
        sites = _sites(steep, away, risk=params)
        shown[gates] = {site.rule for site in sites}
    assert shown[()] <= {"highest_value", "lower_value"}
    assert shown["geometry",] == shown["probability",] == {"steep"}
    assert shown["reach",] == {"out_of_reach"}


def test_traffic_and_plants_are_terms() -> None:
    near = [s for s in _sites(_traffic(), max_candidates=40) if s.position_odom[0] < 8.0]
    assert near and all(_by_name(site)["traffic"].value == pytest.approx(-0.3) for site in near)
    grid = make_grid(_ground())
    grid.max_height_m[:] = grid.min_height_m + 0.25
    among = _sites(grid, risk=SelectorParams(weight_plants=0.4))
    assert among
    for site in among:
        assert _by_name(site)["plants"].value == pytest.approx(-0.4)


def test_rules_name_what_refused_a_site() -> None:
    view, middle = view_of(make_grid(_ground())), np.array([8.0, 8.0])
    params = LandingParams()
    assert check_site(view, ABOVE, params, middle)[0].rule == "commanded"
    assert check_site(view, ABOVE, params, np.array([40.0, 8.0]))[0].rule == "not_seen"
    step = _ground()
    step[:, 41:] += 0.3
    site = check_site(view_of(make_grid(step)), ABOVE, params, middle)[0]
    assert site.rule == "step" and "safe with probability" in site.reason
    avoided = {"avoid_odom": [np.array([8.0, 8.0, 0.0])]}
    sites = _sites(make_grid(_ground()), avoided, refused_radius_m=40.0)
    assert {site.rule for site in sites} <= {"near_refused_site"} and sites
    far = _sites(make_grid(_ground()), {"reach_m": 2.0}, max_candidates=40)
    assert {site.rule for site in far if site.accepted} <= {"highest_value", "lower_value"}
    assert all(np.hypot(*(s.position_odom[:2] - 8.0)) <= 2.2 for s in far if s.accepted)
    assert "out_of_reach" in {site.rule for site in far}
    steep = _sites(make_grid(_ground(7.0)), {"emergency": True})
    assert steep[0].rule == "least_bad" and {s.rule for s in steep[1:]} <= {"steep"}


def test_bonus_for_clearance_chooses_the_cell_and_ranks_none() -> None:
    """A strip 8 m wide between rough ground, nearest at its western edge. A metre costs 0.013; room
    is worth 0.007 a metre, with the bonus 0.027 for the first."""
    strip = _ground()
    rough = np.random.default_rng(2).uniform(0.0, 0.6, (SIDE, SIDE))
    strip[:, :60], strip[:, 100:] = rough[:, :60], rough[:, 100:]
    clearances = []
    for weight in (0.0, 0.02):
        by_distance = SelectorParams(
            terms=("distance", "clearance"),
            gates=("geometry",),
            weight_distance=1.0,
            weight_clearance=weight,
        )
        site = _sites(make_grid(strip), risk=by_distance)[0]
        assert site.value == pytest.approx(sum(term.value for term in site.terms), abs=1e-6)
        assert site.cluster_bonus == pytest.approx(weight * min(site.clearance_m, 1.0), abs=1e-5)
        clearances.append(site.clearance_m)
    assert clearances[0] < 0.5 and clearances[1] >= 1.0


def test_candidates_keep_their_spacing() -> None:
    rough = _ground() + np.random.default_rng(1).normal(0.0, 0.02, (SIDE, SIDE))
    for spacing in (3.0, 5.0):
        sites = _sites(make_grid(rough), candidate_spacing_m=spacing, max_candidates=40)
        xy = np.array([site.position_odom[:2] for site in sites])
        gaps = np.linalg.norm(xy[:, None] - xy[None], axis=2) + np.eye(len(xy)) * 99.0
        assert len(xy) > 1 and gaps.min() >= spacing - 1e-6


def _site(
    value: float, rule: SiteRule, *terms: tuple[TermName, float, float, str], accepted: bool = True
) -> Candidate:
    return Candidate(
        position_odom=np.zeros(3), c_sum=0.5,
        slope_deg=0.0, roughness_m=0.0, clearance_m=3.0, accepted=accepted,
        reason=f"because of {rule}", rule=rule, value=value,
        terms=tuple(ScoreTerm(name=n, value=v, quantity=q, unit=u) for n, v, q, u in terms),
    )  # fmt: skip


_FIRST = _site(
    1.05, "lower_value", ("probability", 0.97, 0.97, ""), ("clearance", 0.10, 3.0, "m"),
    ("slope", -0.02, 0.5, "deg"), ("traffic", 0.0, 0.0, ""),
)  # fmt: skip
_SECOND = _site(
    0.63, "lower_value", ("probability", 0.91, 0.91, ""), ("clearance", 0.05, 1.2, "m"),
    ("slope", -0.02, 0.5, "deg"), ("traffic", -0.3, 1.0, ""),
)  # fmt: skip


def test_reason_compares_the_first_with_the_next_accepted() -> None:
    water = _site(0.9, "water", accepted=False)
    sites = ranked([_FIRST, water, _SECOND])
    assert [site.rule for site in sites] == ["highest_value", "lower_value", "water"]
    assert why_chosen(sites) == (
        "Site 1 won: score 1.050 against 0.630 of site 2; not near traffic; higher probability "
        "of a safe touchdown (0.970 against 0.910); more clearance (3.0 against 1.2 m)"
    )


def test_what_is_written_alike_is_no_reason() -> None:
    alike = [_site(v, "lower_value", ("slope", v, q, "deg")) for v, q in ((0.5, 0.04), (0.4, 0.0))]
    assert why_chosen(ranked(alike)) == "Site 1 won: score 0.500 against 0.400 of site 2"


def test_reason_names_refused_sites_of_a_higher_score() -> None:
    water, road = (
        _site(1.2, rule, accepted=False) for rule in ("water", "unsafe_ground")
    )  # fmt: skip
    alone = why_chosen(ranked([water, _FIRST]))
    assert alone == (
        "Site 1 won: the only one accepted of 2, score 1.050; site 2 scores higher but is refused: "
        "water"
    )
    assert why_chosen(ranked([water, road, _FIRST])).endswith(
        "; sites 2 and 3 score higher but are refused: water and unsafe ground"
    )


def test_reason_without_a_site() -> None:
    step, water = (_site(0.9, rule, accepted=False) for rule in ("step", "water"))
    assert why_chosen(()) == "No site: nothing is mapped"
    assert why_chosen([step, water, step]) == (
        "No site: 3 candidates refused: 2 step, 1 water; "
        "keys: landing.max_step_m, landing.max_missing_ratio"
    )
    assert why_chosen([step]) == "No site: the only candidate is because of step"
    taken = dataclasses.replace(step, accepted=True, rule="least_bad")
    assert why_chosen([taken]) == "Site 1 won as because of step"
    commanded = dataclasses.replace(step, accepted=True, rule="commanded")
    assert why_chosen([commanded]) == "Site 1 was commanded: because of step"
