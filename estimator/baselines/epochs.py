"""Orders late messages of several sensors by the time of measurement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

from touchdown.estimator.filtering.message_order import ArrivingStream, DelayBound
from touchdown.sim.api import (
    BarometerSample,
    CameraImage,
    GpsFix,
    MagnetometerSample,
    Observation,
    RangefinderSample,
    SensorNeeds,
    SensorRig,
)

_PATIENCE_S = 0.3
"""longest delay of an image that is waited for"""
_BEAT_HZ = 10
"""Smallest rate of epochs, independent of messages."""


class _Stamped(Protocol):
    @property
    def tick(self) -> int: ...


T = TypeVar("T", bound=_Stamped)


@dataclass(frozen=True, kw_only=True, slots=True)
class Epoch:
    """An instant at which a filter is corrected: the time of an image or a fix, or a regular beat.
    The samples are those since the previous epoch, oldest first."""

    tick: int
    image: CameraImage | None = None
    fix: GpsFix | None = None
    magnetometer: tuple[MagnetometerSample, ...] = ()
    barometer: tuple[BarometerSample, ...] = ()
    rangefinder: tuple[RangefinderSample, ...] = ()


@dataclass(slots=True)
class _Inbox:
    images: list[CameraImage] = field(default_factory=list)
    fixes: list[GpsFix] = field(default_factory=list)
    magnetometer: list[MagnetometerSample] = field(default_factory=list)
    barometer: list[BarometerSample] = field(default_factory=list)
    rangefinder: list[RangefinderSample] = field(default_factory=list)


class EpochQueue:
    """Delays messages by the largest nominal latency of the sensors in ``needs``, and by that of an
    image that is later than that and still to be expected.

    ``late`` counts images and fixes that came after their epoch.
    """

    def __init__(self, rig: SensorRig, needs: SensorNeeds) -> None:
        nav = rig.nav
        patience = max(rig.compute_latency_ticks, round(_PATIENCE_S * rig.tick_hz))
        self._images = ArrivingStream(
            rig.tick_hz // needs.camera_hz if needs.camera_hz else 0,
            DelayBound(rig.compute_latency_ticks, patience),
        )
        latencies = [
            rig.compute_latency_ticks if needs.camera_hz else 0,
            nav.gps.latency_ticks if needs.gps else 0,
            nav.barometer.latency_ticks if needs.barometer else 0,
            nav.magnetometer.latency_ticks if needs.magnetometer else 0,
            nav.rangefinder.latency_ticks if needs.rangefinder else 0,
        ]
        self._lag = max(latencies)
        self._beat = rig.tick_hz // _BEAT_HZ
        self._last = 0
        self._inbox = _Inbox()
        self.late = 0

    def take(self, obs: Observation) -> list[Epoch]:
        """Adds the arrived messages; returns the epochs that are complete now, oldest first."""
        inbox = self._inbox
        for image in obs.images:
            self._images.take(image.tick, obs.tick)
        inbox.images += self._in_time(obs.images)
        inbox.fixes += self._in_time(obs.gps)
        inbox.magnetometer += obs.magnetometer
        inbox.barometer += obs.barometer
        inbox.rangefinder += obs.rangefinder
        horizon = obs.tick - self._lag
        ticks = {image.tick for image in inbox.images} | {fix.tick for fix in inbox.fixes}
        ticks |= set(range((self._last // self._beat + 1) * self._beat, horizon + 1, self._beat))
        complete = []
        for tick in sorted(ticks):
            if tick > horizon or self._images.may_bring(tick + 1, obs.tick):
                break
            complete.append(self._epoch(tick))
        return complete

    def _in_time(self, messages: Sequence[T]) -> list[T]:
        kept = [message for message in messages if message.tick > self._last]
        self.late += len(messages) - len(kept)
        return kept

    def _epoch(self, tick: int) -> Epoch:
        self._last = tick
        inbox = self._inbox
        images, fixes = _split(inbox.images, tick), _split(inbox.fixes, tick)
        return Epoch(
            tick=tick, image=images[-1] if images else None, fix=fixes[-1] if fixes else None,
            magnetometer=tuple(_split(inbox.magnetometer, tick)),
            barometer=tuple(_split(inbox.barometer, tick)),
            rangefinder=tuple(_split(inbox.rangefinder, tick)),
        )  # fmt: skip


def _split(messages: list[T], tick: int) -> list[T]:
    """Removes and returns those measured at or before ``tick``, oldest first."""
    due = sorted((m for m in messages if m.tick <= tick), key=lambda m: m.tick)
    messages[:] = [m for m in messages if m.tick > tick]
    return due
