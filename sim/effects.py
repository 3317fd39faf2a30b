"""Effects of fog, rain, dust, dirt, glare and the lamp on messages, counted where they are applied.

Worker threads `note` the effects on the message that they make; those of a message count once it is
delivered, so that the numbers of a flight do not depend on its threads.
"""

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from touchdown.sim.api import FAULT_KINDS, FaultParams
from touchdown.sim.typing import Bytes, Float32

CHANGED_M = 0.1
"""A return has changed where its range has by five standard deviations of the range noise."""
_MEASURED_KINDS = ("miscalibration", "fog", "rain", "lens_dirt", "low_sun")
_STRIDE = 8
"""step between the rows and columns of an image that are compared"""


@dataclass(slots=True)
class Effect:
    """The effect on the messages of one sensor; ``fraction`` and ``amount`` are sums over
    messages."""

    came: int = 0
    """messages that the effect acted on"""
    messages: int = 0
    """messages that it changed"""
    fraction: float = 0.0
    """changed fraction of each message's parts (returns, pixels)"""
    amount: float = 0.0
    """size of the change, in units of the effect"""

    def add(self, other: "Effect") -> None:
        self.came += other.came
        self.messages += other.messages
        self.fraction += other.fraction
        self.amount += other.amount

    @property
    def mean_fraction(self) -> float:
        """Mean over the messages that it acted on, 0 without one."""
        return self.fraction / self.came if self.came else 0.0

    @property
    def mean_amount(self) -> float:
        """Mean over the messages that it acted on, 0 without one."""
        return self.amount / self.came if self.came else 0.0


class Effects:
    """Effects on the messages of one sensor, by name."""

    def __init__(self) -> None:
        self.delivered: dict[str, Effect] = {}
        self._now: dict[str, Effect] = {}
        self._made: deque[dict[str, Effect]] = deque()

    def note(self, names: Iterable[str], fraction: float, amount: float = 0.0) -> None:
        """Notes an effect on the message that is being made: the changed fraction of it."""
        for name in names:
            new = Effect(came=1, messages=int(fraction > 0.0), fraction=fraction, amount=amount)
            self._now.setdefault(name, Effect()).add(new)

    def note_image(self, names: Iterable[str], before: Bytes, after: Bytes) -> None:
        """Notes the fraction of pixels of (H, W, 3) images that differ, and by how many grey levels
        pixels do on average."""
        old, new = (image[::_STRIDE, ::_STRIDE].astype(np.int16) for image in (before, after))
        change = np.abs(new - old)
        self.note(names, float((change > 0).any(axis=-1).mean()), float(change.mean()))

    def note_lengths(self, name: str, count: int, changed: int, total_m: float) -> None:
        """Notes how many of ``count`` lengths have ``changed``, and by how much all of them."""
        self.note((name,), changed / count, total_m / max(changed, 1))

    def end_message(self) -> None:
        """Ends the message that is being made."""
        self._made.append(self._now)
        self._now = {}

    def deliver(self, count: int) -> None:
        """Counts the effects on the next ``count`` messages, which are being delivered."""
        for _ in range(count):
            for name, effect in self._made.popleft().items():
                self.delivered.setdefault(name, Effect()).add(effect)

    def clear(self) -> None:
        """Forgets the flight."""
        self.delivered = {}
        self._now = {}
        self._made.clear()


class WorldRecord(NamedTuple):
    """Faults, effects and deviations of a flight so far: not for estimators or landers."""

    faults: list[dict[str, Any]]
    """records of the scheduled faults"""
    effects: Mapping[str, Mapping[str, Effect]]
    """effects on delivered ``scans`` and ``images`` and on the ``air`` at the vehicle, by name"""
    deviations: Mapping[str, float]
    """drawn errors of vehicle and IMU: ``mass_fraction``, ``center_of_mass_m``, ``rotor_fraction``,
    ``imu_scale``, ``imu_misalignment_deg`` (the last two root mean squares over the axes)"""
    renderer: str | None = None
    """what drew the images (`camera.gl_contexts.renderer_name`); None without an image"""


class Returns(NamedTuple):
    """(N,) ranges in metres and intensities of a scan."""

    ranges: Float32
    intensity: Bytes

    def copy(self) -> "Returns":
        return Returns(self.ranges.copy(), self.intensity.copy())

    def changed_fraction(self, before: "Returns") -> float:
        """Fraction of returns of another intensity, or of a range that differs by more than
        ``CHANGED_M``."""
        moved = np.abs(self.ranges - before.ranges) > CHANGED_M
        changed = moved | (self.intensity != before.intensity)
        return float(changed.mean()) if len(changed) else 0.0


def fault_records(
    params: FaultParams, sensors: Mapping[str, Mapping[str, Effect]], sun_deg: float | None
) -> list[dict[str, Any]]:
    """Records of the scheduled faults that change what is measured, in the form of
    `sim.faults.injector.FaultInjector.summary`, one of each kind; ``sensors``: effects by stream
    and name; ``sun_deg``: the elevation of the scene's sun, None without one.

    ``returns_changed`` is the mean fraction of returns that it weakened, removed or added in a
    scan, ``grey_change`` the mean change of a pixel in grey levels, ``rotation_deg`` the mean
    rotation of the LIDAR.
    """
    records = []
    for kind in _MEASURED_KINDS:
        texts = [fault.text for fault in params.schedule() if fault.kind == kind]
        if not texts:
            continue
        record: dict[str, Any] = {"fault": ", ".join(texts), "messages": {}, "came": {}}
        for stream in FAULT_KINDS[kind]:
            effect = sensors.get(stream, {}).get(kind, Effect())
            record["messages"][stream], record["came"][stream] = effect.messages, effect.came
            if kind == "miscalibration":
                record["rotation_deg"] = effect.mean_amount
            elif stream == "scans":
                record["returns_changed"] = effect.mean_fraction
            else:
                record["grey_change"] = effect.mean_amount
        if kind == "low_sun" and sun_deg is not None:
            record["sun_deg"] = sun_deg
        records.append(record)
    return records
