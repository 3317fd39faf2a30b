"""PX4 as a controller: sensors and estimate in, rotor speeds out, one exchange an IMU sample."""

import contextlib
import tempfile
import time
from pathlib import Path

import numpy as np

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, MapView
from touchdown.experiments.config.schema import Config
from touchdown.experiments.px4.airframe import Motors, parameters
from touchdown.experiments.px4.commander import Commander
from touchdown.experiments.px4.link import (
    FREE_STEP_S,
    CommandLink,
    SimulatorLink,
    accept,
    reserve,
)
from touchdown.experiments.px4.messages import Messages, Px4Error, dialect
from touchdown.experiments.px4.process import Px4Process, find_px4
from touchdown.landing.api import Lander, LanderView
from touchdown.sim.api import Command, Observation, SensorNeeds, SensorRig

_READ_LOG_STEPS = 40
_ENDS_S = 1.0
"""wall time in which a PX4 that broke off ends"""


def check_px4(config: Config) -> None:
    """Raises Px4Error, one line with what to do, where PX4 cannot control a flight."""
    dialect()
    if not config.px4.connect:
        find_px4(config.px4)
    sim = config.sim
    if sim.control_ticks % sim.imu_ticks:
        raise Px4Error(
            f"controller px4 needs an IMU sample in every control step: sim.imu_ticks = "
            f"{sim.imu_ticks} must divide sim.control_ticks = {sim.control_ticks}"
        )
    for name in ("odometry_hz", "setpoint_hz"):
        rate, control = getattr(config.px4, name), config.control.control_hz
        if control % rate:
            raise Px4Error(f"px4.{name} = {rate} must divide control.control_hz = {control}")


class Px4Autopilot:
    """Implements ``controller.api.Controller``. PX4 is started, or waited for, at the first call.

    ``sense`` takes each observation before ``update`` is called. Raises Px4Error where PX4 does not
    keep to the protocol.
    """

    def __init__(self, config: Config, rig: SensorRig) -> None:
        check_px4(config)
        self._params, self._rig = config.px4, rig
        self._parameters = parameters(rig, config.px4, config.control.max_tilt_deg)
        self._motors = Motors(rig.vehicle)
        self._messages = Messages(rig)
        self.needs = SensorNeeds(barometer=True, magnetometer=True, gps=config.px4.aid == "gps")
        self._site_m = rig.nav.barometer.site_elevation_m
        control_hz = config.control.control_hz
        self._odometry_steps = control_hz // self._params.odometry_hz
        self._setpoint_steps = control_hz // self._params.setpoint_hz
        self._step = 0
        self._obs: Observation | None = None
        self._closing = contextlib.ExitStack()
        self._keep_in: Path | None = None
        self._of_failure: Path | None = None
        self._link: SimulatorLink | None = None
        self._commander: Commander | None = None
        self._was_healthy, self._resets = True, 0
        self._armed = False
        self._process: Px4Process | None = None

    def keep_in(self, folder: Path, of_failure: Path | None = None) -> None:
        """PX4 works below ``folder``, and leaves its log there; of a flight that it breaks off,
        in ``of_failure``."""
        self._keep_in, self._of_failure = folder, of_failure

    @property
    def waits(self) -> bool:
        """True while the mission is to wait for PX4 to arm."""
        return self._commander is not None and self._commander.waits

    @property
    def lockstep(self) -> tuple[int, int]:
        """Steps since the first answer, and the answers to them."""
        return (0, 0) if self._link is None else (self._link.steps, self._link.answers)

    def holding(self, lander: Lander) -> Lander:
        """``lander``, which is not asked for anything new while PX4 arms."""
        return _WaitingLander(lander, self)

    def sense(self, obs: Observation) -> None:
        """Takes what the sensors have sent."""
        self._obs = obs

    def update(self, estimate: Estimate, setpoint: Setpoint) -> Command:
        """The rotor speeds that PX4 wants; 0 before it has answered for the first time."""
        if self._link is None or self._commander is None:
            self._link, self._commander = self._start()
        obs, commander = self._obs, self._commander
        assert obs is not None
        try:
            speeds = self._exchange(self._link, obs)
            if not commander.heard and self._link.in_lockstep:
                time.sleep(FREE_STEP_S)  # PX4 starts in wall time
            self._send_estimate(self._link, estimate)
            if self._step % self._setpoint_steps == 0:
                commander.send_setpoint(setpoint, estimate)
            commander.step(estimate, setpoint, self._armed)
        except Px4Error as error:
            raise Px4Error(self._failure(str(error))) from error
        self._step += 1
        said = commander.events()
        if self._process is not None and self._step % _READ_LOG_STEPS == 0:
            said += tuple(f"PX4: {text}" for text in self._process.warnings())
        return Command(rotor_speed_radps=speeds, events=said)

    def close(self) -> None:
        """Ends PX4 where it was started here."""
        self._closing.close()

    def _failure(self, line: str) -> str:
        """``line`` with what PX4 has printed, and where its log is."""
        if self._process is None:
            return line
        parts = [line, self._ended(_ENDS_S)]
        if printed := self._process.printed():
            parts.append(f"it printed: {printed}")
        if self._of_failure is not None:
            self._process.keep_log(self._of_failure)
            parts.append(f"its log is '{self._of_failure}'")
        return "; ".join(filter(None, parts))

    def _ended(self, wait_s: float) -> str:
        return "" if self._process is None else self._process.ended(wait_s)

    def _start(self) -> tuple[SimulatorLink, Commander]:
        params = self._params
        ports = reserve(params.port, exactly=params.connect)
        self._closing.callback(ports.close)
        if not params.connect:
            folder = self._keep_in
            if folder is None:
                folder = Path(self._closing.enter_context(tempfile.TemporaryDirectory()))
            process = Px4Process(params, ports, folder / "px4", self._parameters)
            self._closing.callback(process.close, self._keep_in, params.ulog)
            self._process = process
        connection = accept(ports, params.start_s, self._ended)
        link = SimulatorLink(connection, params.start_s, params.answer_s, self._motors.count)
        self._closing.callback(link.close)
        return link, Commander(CommandLink(ports), self._messages, params)

    def _exchange(self, link: SimulatorLink, obs: Observation) -> np.ndarray:
        for fix in obs.gps if self.needs.gps else ():
            link.send(self._messages.fix(fix, self._site_m))
        magnetometer = obs.magnetometer[-1] if obs.magnetometer else None
        barometer = obs.barometer[-1] if obs.barometer else None
        speeds = off = np.zeros(self._motors.count)
        for imu in obs.imu:
            answer = link.exchange(self._messages.sensors(imu, magnetometer, barometer))
            magnetometer = barometer = None
            if answer is not None:
                self._armed = answer.armed
                speeds = self._motors.speeds(answer.controls) if answer.armed else off
        return speeds

    def _send_estimate(self, link: SimulatorLink, estimate: Estimate) -> None:
        """After the answer, when PX4 is idle at the time of this step."""
        if estimate.healthy and not self._was_healthy:
            self._resets += 1
        self._was_healthy = estimate.healthy
        if estimate.healthy and self._step and self._step % self._odometry_steps == 0:
            link.send(self._messages.odometry(estimate, self._resets))


class _WaitingLander:
    """A lander that is not asked for anything new while the autopilot arms."""

    def __init__(self, inner: Lander, autopilot: Px4Autopilot) -> None:
        self._inner, self._autopilot = inner, autopilot
        self.needs = inner.needs
        self._last: Setpoint | None = None

    def update(self, obs: Observation, estimate: Estimate, map_view: MapView) -> Setpoint:
        """The setpoint of the lander, or the last one."""
        if self._last is None or not self._autopilot.waits:
            self._last = self._inner.update(obs, estimate, map_view)
        return self._last

    def view(self) -> LanderView:
        """The state of the lander."""
        return self._inner.view()
