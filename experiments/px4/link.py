"""The two connections to PX4: the simulator's, in lockstep, and an onboard computer's."""

import contextlib
import math
import select
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from touchdown.experiments.px4.messages import Px4Error, dialect

LOCALHOST = "127.0.0.1"
FIRST_PORT, PORTS = 4560, 100
"""of the simulator: PX4's instance N connects to 4560 + N"""
_OWN_UDP, _UDP_OF_PX4 = 14540, 14580
"""of an onboard computer and of PX4, likewise"""
FREE_STEP_S = 0.003
"""wall time that a step takes before PX4 has answered for the first time"""
_READ_BYTES = 1 << 16


@dataclass(frozen=True, slots=True)
class Answer:
    """HIL_ACTUATOR_CONTROLS."""

    controls: list[float]
    """of the four motors, 0 to 1"""
    armed: bool


@dataclass(slots=True)
class Ports:
    """Sockets that are reserved for one PX4, and its instance."""

    instance: int
    server: socket.socket
    datagrams: socket.socket

    def close(self) -> None:
        """Closes both."""
        self.server.close()
        self.datagrams.close()

    @property
    def of_px4(self) -> int:
        """UDP port at which PX4 listens."""
        return _UDP_OF_PX4 + self.instance

    @property
    def own(self) -> int:
        """UDP port to which PX4 sends."""
        return _OWN_UDP + self.instance


def reserve(port: int, *, exactly: bool) -> Ports:
    """Reserves ``port`` and its companions, or with ``exactly`` False the next that are free.
    Raises Px4Error where none is."""
    last = port + 1 if exactly else FIRST_PORT + PORTS
    for number in range(port, last):
        instance = number - FIRST_PORT
        with contextlib.ExitStack() as opened:
            try:
                server = opened.enter_context(socket.socket())
                server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                server.bind((LOCALHOST, number))
                server.listen(1)
                own = opened.enter_context(socket.socket(type=socket.SOCK_DGRAM))
                own.bind((LOCALHOST, _OWN_UDP + instance))
                if not exactly:
                    with socket.socket(type=socket.SOCK_DGRAM) as probe:
                        probe.bind(("", _UDP_OF_PX4 + instance))
            except OSError:
                continue
            opened.pop_all()
            own.setblocking(False)
            return Ports(instance, server, own)
    raise Px4Error(
        f"port {port} of this machine, or UDP port {_OWN_UDP + port - FIRST_PORT}, is taken: end "
        "what waits there, or give another --px4-port"
    )


class SimulatorLink:
    """The simulator's end of the lockstep: HIL_SENSOR goes out, one HIL_ACTUATOR_CONTROLS of the
    same time comes back.

    Until the first answer steps go on by themselves, ``FREE_STEP_S`` of wall time each: PX4 starts
    by the clock of the sensors, and would wait for it for ever.
    """

    def __init__(
        self, connection: socket.socket, start_s: float, answer_s: float, motors: int = 4
    ) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._motors = motors
        self._socket = connection
        self._common: Any = dialect()
        self._mav = self._common.MAVLink(None, srcSystem=1, srcComponent=51)
        self._mav.robust_parsing = True
        self._answer_s = answer_s
        self._waited_s = 0.0
        self._start_s = start_s
        self._first_us = 0
        """time of the first step in lockstep; 0: none yet"""
        self._before_us = 0
        self._pending: list[Any] = []
        self.steps = self.answers = 0
        """in lockstep"""

    @property
    def in_lockstep(self) -> bool:
        """True from the first answer on."""
        return self._first_us > 0

    def send(self, message: Any) -> None:
        """Sends a message that has no answer. Raises Px4Error where the connection is closed."""
        try:
            self._socket.settimeout(self._answer_s)
            self._socket.sendall(message.pack(self._mav))
        except OSError as error:
            raise Px4Error(f"PX4 has closed the connection ({error.strerror})") from error

    def exchange(self, sensors: Any) -> Answer | None:
        """The answer to a HIL_SENSOR; None before the first one. Raises Px4Error for one that does
        not come, comes twice, or is of another time or not a number."""
        now, before = int(sensors.time_usec), self._before_us
        self._before_us = now
        at = f"at {1e-6 * now:.3f} s PX4"
        self._refuse_more(at)
        self.send(sensors)
        if not self.in_lockstep:
            started = time.monotonic()
            answer = self._receive(FREE_STEP_S, at)
            self._waited_s += time.monotonic() - started  # the rest of a step may compile for long
            if answer is None:
                if self._waited_s > self._start_s:
                    raise Px4Error(f"PX4 is connected, but gave no answer in {self._start_s:g} s")
                return None
            self._first_us = now + 1
            return self._checked(answer, at)
        self.steps += 1
        answer = self._receive(self._answer_s, at)
        while answer is not None and answer.time_usec < self._first_us:
            answer = self._receive(self._answer_s, at)  # to a step of the start
        if answer is None:
            raise Px4Error(f"{at} gave no answer in {self._answer_s:g} s (px4.answer_s)")
        if answer.time_usec == before:
            raise _twice(at)
        if answer.time_usec != now:
            raise Px4Error(
                f"{at} answered for another time, {1e-6 * answer.time_usec:.3f} s: it does not run "
                "in lockstep"
            )
        self.answers += 1
        return self._checked(answer, at)

    def close(self) -> None:
        """Closes the connection."""
        self._socket.close()

    def _refuse_more(self, at: str) -> None:
        """Raises Px4Error for an answer that nobody asked for."""
        if not self.in_lockstep:
            return
        if not self._pending:
            self._read(0.0, at)
        late = [m for m in self._pending if m.time_usec >= self._first_us]
        if late:
            raise _twice(at)

    def _checked(self, message: Any, at: str) -> Answer:
        controls = [float(value) for value in message.controls[: self._motors]]
        if not all(map(math.isfinite, controls)):
            raise Px4Error(f"{at} gave a control that is not a number: {controls}")
        armed = bool(message.mode & self._common.MAV_MODE_FLAG_SAFETY_ARMED)
        return Answer(controls, armed)

    def _receive(self, wait_s: float, at: str) -> Any:
        """The next HIL_ACTUATOR_CONTROLS; None where none comes in time."""
        deadline = time.monotonic() + wait_s
        while not self._pending:
            left = deadline - time.monotonic()
            if left <= 0.0:
                return None
            self._read(left, at)
        return self._pending.pop(0)

    def _read(self, wait_s: float, at: str) -> None:
        if not select.select([self._socket], [], [], wait_s)[0]:
            return
        try:
            data = self._socket.recv(_READ_BYTES)
        except OSError as error:
            raise Px4Error(f"{at} has closed the connection ({error.strerror})") from error
        if not data:
            raise Px4Error(f"{at} has closed the connection")
        wanted = self._common.MAVLINK_MSG_ID_HIL_ACTUATOR_CONTROLS
        for message in self._mav.parse_buffer(data) or ():
            if message.get_msgId() == wanted:
                self._pending.append(message)


def _twice(at: str) -> Px4Error:
    return Px4Error(f"{at} had answered the step before twice: it does not run in lockstep")


def accept(ports: Ports, wait_s: float, ended: Callable[[float], str]) -> socket.socket:
    """Waits for PX4 to connect. ``ended`` gives the reason where it will not. Raises Px4Error."""
    deadline = time.monotonic() + wait_s
    while time.monotonic() < deadline:
        if select.select([ports.server], [], [], 0.1)[0]:
            connection, _ = ports.server.accept()
            return connection
        if reason := ended(0.0):
            raise Px4Error(reason)
    port = ports.server.getsockname()[1]
    raise Px4Error(f"no PX4 connected to port {port} in {wait_s:g} s (px4.start_s)")


class CommandLink:
    """An onboard computer's connection over UDP."""

    def __init__(self, ports: Ports) -> None:
        self._socket = ports.datagrams
        self._address = (LOCALHOST, ports.of_px4)
        self._mav = dialect().MAVLink(None, srcSystem=1, srcComponent=191)
        self._mav.robust_parsing = True

    def send(self, message: Any) -> None:
        """Sends a message; nobody may listen yet."""
        with contextlib.suppress(OSError):
            self._socket.sendto(message.pack(self._mav), self._address)

    def receive(self) -> list[Any]:
        """Messages that have come."""
        found: list[Any] = []
        while True:
            try:
                data = self._socket.recv(_READ_BYTES)
            except OSError:
                return found
            found += self._mav.parse_buffer(data) or ()
