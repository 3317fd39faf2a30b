"""The onboard computer's part: setpoints, mode, arming, and what PX4 says of itself."""

import math
from collections import deque
from typing import Any

import numpy as np

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate
from touchdown.experiments.api import Px4Params
from touchdown.experiments.errors import visible
from touchdown.experiments.px4.link import CommandLink
from touchdown.experiments.px4.messages import Messages, Px4Error, ned
from touchdown.sim.typing import Array

_ASK_AGAIN_S = 0.5
_SPOOLED_S = 0.6
_HEARTBEAT_S = 1.0
_SAID_AGAIN_S = 5.0
_MAIN_OFFBOARD, _MAIN_AUTO = 6, 4
_MAIN_MODES = {1: "MANUAL", 2: "ALTCTL", 3: "POSCTL", 5: "ACRO", 6: "OFFBOARD", 7: "STABILIZED"}
_AUTO_MODES = {1: "READY", 2: "TAKEOFF", 3: "HOLD", 4: "MISSION", 5: "RETURN", 6: "LAND"}
_LANDED = {1: "on the ground", 2: "in the air", 3: "taking off", 4: "landing"}
_WARNING = 4
"""MAV_SEVERITY"""
_FORCE = 21196.0
"""disarms in the air too"""


_KEPT_S = 0.5
"""of estimates, for messages of earlier steps"""
_JUMP_M = 1.0
"""A larger change is a reset of PX4's estimate, and counts at once."""
_SMOOTHING = 0.02
"""of each message, 50 a second: a second"""


def mode_name(custom_mode: int) -> str:
    """Name of PX4's mode in a HEARTBEAT."""
    main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
    if main == _MAIN_AUTO:
        return f"AUTO.{_AUTO_MODES.get(sub, sub)}"
    return _MAIN_MODES.get(main, f"mode {main}")


class Commander:
    """Asks for OFFBOARD and arms when the lander wants motors, disarms when it wants none, and
    collects what PX4 says as events.

    ``waits`` is True while the lander wants motors and PX4 has not spooled them up for the first
    time. Raises Px4Error where that takes more than ``px4.arm_s``.
    """

    def __init__(self, link: CommandLink, messages: Messages, params: Px4Params) -> None:
        self._link, self._messages, self._params = link, messages, params
        self._common = messages.common
        self._mode: int | None = None
        self._system = 0
        self._armed = False
        self._armed_at: float | None = None
        self._wanted_at: float | None = None
        self._released = self._flown = False
        self._next_ask = self._next_heartbeat = 0.0
        self._landed = 0
        self._version_known = False
        self._said: dict[str, float] = {}
        self._reasons: list[str] = []
        self._events: list[str] = []
        self._frame = LocalFrame(moves=params.aid == "gps")

    @property
    def waits(self) -> bool:
        """True while the mission is to wait for PX4."""
        return self._wanted_at is not None and not self._released

    @property
    def heard(self) -> bool:
        """True once PX4's MAVLink is up."""
        return self._mode is not None

    def events(self) -> tuple[str, ...]:
        """What has been said since the last call."""
        said, self._events = tuple(self._events), []
        return said

    def step(self, estimate: Estimate, setpoint: Setpoint, armed: bool) -> None:
        """One control step: reads what has come, asks for what the lander wants."""
        time_s = estimate.time_s
        self._frame.note(estimate)
        for message in self._link.receive():
            self._take(message, time_s)
        self._follow_arming(time_s, armed)
        if time_s >= self._next_heartbeat:
            self._next_heartbeat = time_s + _HEARTBEAT_S
            self._link.send(self._messages.heartbeat())
            if self.heard and not self._version_known:
                self._command("MAV_CMD_REQUEST_MESSAGE",
                              self._common.MAVLINK_MSG_ID_AUTOPILOT_VERSION)  # fmt: skip
        if setpoint.motors_on:
            self._want_flight(time_s)
        elif self._flown and self._armed and time_s >= self._next_ask:
            self._next_ask = time_s + _ASK_AGAIN_S
            self._command("MAV_CMD_COMPONENT_ARM_DISARM", 0.0, _FORCE)

    def send_setpoint(self, setpoint: Setpoint, estimate: Estimate) -> None:
        """Sends a setpoint; without motors that of resting here."""
        time_s = estimate.time_s
        if not setpoint.motors_on:
            here = estimate.odom_from_body.translation
            setpoint = Setpoint(
                position_odom=here,
                velocity_odom=np.zeros(3),
                acceleration_odom=np.zeros(3),
                yaw_odom=setpoint.yaw_odom,
                thrust_limit=0.0,
            )
        self._link.send(self._messages.setpoint(setpoint, time_s, self._frame.offset_ned))

    def _want_flight(self, time_s: float) -> None:
        if self._wanted_at is None:
            self._wanted_at = time_s
        if self._released:
            return
        offboard = self._mode is not None and self._mode >> 16 & 0xFF == _MAIN_OFFBOARD
        if self._armed and offboard and self._armed_at is not None:
            self._released = self._flown = time_s >= self._armed_at + _SPOOLED_S
        elif time_s >= self._next_ask and self.heard and self._frame.known:
            self._next_ask = time_s + _ASK_AGAIN_S
            custom = self._common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            self._command("MAV_CMD_DO_SET_MODE", custom, _MAIN_OFFBOARD)
            if offboard:
                self._command("MAV_CMD_COMPONENT_ARM_DISARM", 1.0)
        if not self._released and time_s > self._wanted_at + self._params.arm_s:
            said = "; ".join(self._reasons[-3:]) or "it says nothing"
            raise Px4Error(f"PX4 did not arm within {self._params.arm_s:g} s (px4.arm_s): {said}")

    def _command(self, name: str, *values: float) -> None:
        number = getattr(self._common, name)
        self._link.send(self._messages.command(self._system, number, *values))

    def _follow_arming(self, time_s: float, armed: bool) -> None:
        if armed == self._armed:
            return
        self._armed = armed
        self._armed_at = time_s if armed else None
        self._events.append("PX4: armed" if armed else "PX4: disarmed")

    def _take(self, message: Any, time_s: float) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT" and message.autopilot == self._common.MAV_AUTOPILOT_PX4:
            if message.custom_mode != self._mode:
                self._events.append(f"PX4: mode {mode_name(message.custom_mode)}")
            self._mode, self._system = message.custom_mode, message.get_srcSystem()
        elif kind == "STATUSTEXT":
            self._say(message, time_s)
        elif kind == "LOCAL_POSITION_NED":
            self._frame.take(message)
        elif kind == "EXTENDED_SYS_STATE" and message.landed_state != self._landed:
            self._landed = message.landed_state
            if self._landed in _LANDED:
                self._events.append(f"PX4: {_LANDED[self._landed]}")
        elif kind == "AUTOPILOT_VERSION" and not self._version_known:
            self._version_known = True
            self._events.append(f"PX4: version {version_text(message)}")

    def _say(self, message: Any, time_s: float) -> None:
        text = visible(message.text.rstrip("\t\0 "))
        self._reasons.append(text)
        del self._reasons[:-3]
        again = time_s - self._said.get(text, -math.inf) < _SAID_AGAIN_S
        if message.severity <= _WARNING and not again:
            self._said[text] = time_s
            self._events.append(f"PX4: {text}")


def version_text(message: Any) -> str:
    """Release and commit of an AUTOPILOT_VERSION."""
    number = message.flight_sw_version
    commit = bytes(message.flight_custom_version)[::-1].hex()
    return f"{number >> 24 & 0xFF}.{number >> 16 & 0xFF}.{number >> 8 & 0xFF} ({commit})"


class LocalFrame:
    """Offset of PX4's local frame, north, east, down, from the odom frame.

    On vision alone both are the same. With satellites PX4 puts its origin where the first fix was,
    and follows them: setpoints are given where they are meant against the estimate of that time.
    """

    def __init__(self, moves: bool) -> None:
        self._moves = moves
        self._estimates: deque[tuple[float, Array]] = deque()
        self._offset: Array | None = None if moves else np.zeros(3)

    @property
    def known(self) -> bool:
        """True where setpoints can be given."""
        return self._offset is not None

    @property
    def offset_ned(self) -> Array:
        """(3,) m, of the same point in PX4's frame, less that in the odom frame."""
        return np.zeros(3) if self._offset is None else self._offset

    def note(self, estimate: Estimate) -> None:
        """Takes the estimate of this control step."""
        if not self._moves:
            return
        self._estimates.append(
            (estimate.time_s, np.array(ned(estimate.odom_from_body.translation)))
        )
        while self._estimates[0][0] < estimate.time_s - _KEPT_S:
            self._estimates.popleft()

    def take(self, message: Any) -> None:
        """Takes a LOCAL_POSITION_NED, which is of an earlier step."""
        if not self._moves or not self._estimates:
            return
        time_s = 1e-3 * message.time_boot_ms
        _, there = min(self._estimates, key=lambda one: abs(one[0] - time_s))
        found = np.array([message.x, message.y, message.z]) - there
        if self._offset is None or math.dist(found, self._offset) > _JUMP_M:
            self._offset = found
        else:
            self._offset = self._offset + _SMOOTHING * (found - self._offset)
