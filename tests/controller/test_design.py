import json
from pathlib import Path

import control
import numpy as np
import pytest

from touchdown.controller import design
from touchdown.controller.api import ControlParams
from touchdown.controller.pid import cascade_gains

from support.command import Says, lines_of
from support.flight_dynamics import example_vehicle

ROOT = Path(__file__).parents[2]


def test_margins_of_an_integrator_behind_a_delay_are_those_of_theory() -> None:
    # L(z) = K dt / (z (z - 1)): phase -90 deg - 1.5 w dt, gain K dt / (2 sin(w dt / 2)).
    step, gain = 0.01, 20.0
    loop = control.ss(1.0, step * gain, 1.0, 0.0, step) * control.ss(0.0, 1.0, 1.0, 0.0, step)
    margin = design._margin("integrator", loop)
    crossover = 2.0 * np.arcsin(gain * step / 2.0) / step
    assert margin.crossover_rad_s == pytest.approx(crossover, rel=1e-4)
    assert margin.phase_margin_deg == pytest.approx(90 - np.degrees(1.5 * crossover * step), 1e-3)
    assert margin.gain_margin_db == pytest.approx(-20 * np.log10(gain * step), abs=0.01)


def test_too_fast_a_rate_loop_shows_in_its_margin() -> None:
    margins = design.loop_margins(example_vehicle(), ControlParams(rate_radps=90.0))
    assert margins[0].gain_margin_db < design.MIN_GAIN_MARGIN_DB


def test_gains_are_the_closed_forms() -> None:
    gains = cascade_gains(
        ControlParams(
            velocity_xy_radps=4.0, velocity_integral_ratio=5.0, acceleration_feedback=0.5,
            rate_radps=20.0, rate_derivative_s=0.01,
        )
    )  # fmt: skip
    assert gains.velocity.kp[0] == pytest.approx(1.5 * 4.0)
    assert gains.velocity.ki[0] == pytest.approx(1.5 * 16.0 / 5.0) and gains.velocity.kd[0] == 0.5
    assert gains.rate.kd[1] == pytest.approx(0.2)


def test_flying_does_not_import_python_control() -> None:
    script = "import sys, touchdown.controller.cascade; print('control' in sys.modules)"
    assert lines_of(script) == ["False"]


def test_the_command_prints_the_margins_of_every_loop(says: Says) -> None:
    rows = json.loads(says(0, "control", "margins", "--json").out)["loops"]
    assert len(rows) == 11
    for row in rows:
        assert row["gain_margin_db"] >= design.MIN_GAIN_MARGIN_DB
        assert row["phase_margin_deg"] >= design.MIN_PHASE_MARGIN_DEG
