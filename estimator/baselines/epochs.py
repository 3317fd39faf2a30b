"""Orders late messages of several sensors by the time of measurement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from touchdown.estimator.filtering.synchronizer import ArrivingStream
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
_EVENTS, _SAMPLES = ("images", "gps"), ("magnetometer", "barometer", "rangefinder")
"""fields of `Observation`: messages that are epochs, and what is used at the next one"""
_BEAT_HZ = 10
"""Smallest rate of epochs, independent of messages."""


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
            rig.compute_latency_ticks,
            patience,
        )
        sensors = ("gps", "barometer", "magnetometer", "rangefinder")
        latencies = [getattr(nav, name).latency_ticks for name in sensors if getattr(needs, name)]
        self._lag = max([rig.compute_latency_ticks if needs.camera_hz else 0, *latencies])
        self._beat = rig.tick_hz // _BEAT_HZ
        self._last = 0
        self._waiting: dict[str, list[Any]] = {name: [] for name in (*_EVENTS, *_SAMPLES)}
        self.late = 0

    def take(self, obs: Observation) -> list[Epoch]:
        """Adds the arrived messages; returns the epochs that are complete now, oldest first."""
        for image in obs.images:
            self._images.take(image.tick, obs.tick)
        for name, waiting in self._waiting.items():
            arrived = getattr(obs, name)
            waiting += self._in_time(arrived) if name in _EVENTS else arrived
        horizon = obs.tick - self._lag
        ticks = {message.tick for name in _EVENTS for message in self._waiting[name]}
        ticks |= set(range((self._last // self._beat + 1) * self._beat, horizon + 1, self._beat))
        complete = []
        for tick in sorted(ticks):
            if tick > horizon or self._images.may_bring(tick + 1, obs.tick):
                break
            complete.append(self._epoch(tick))
        return complete

    def _in_time(self, messages: Sequence[Any]) -> list[Any]:
        kept = [message for message in messages if message.tick > self._last]
        self.late += len(messages) - len(kept)
        return kept

    def _epoch(self, tick: int) -> Epoch:
        self._last = tick
        images, fixes = (_split(self._waiting[name], tick) for name in _EVENTS)
        samples = {name: tuple(_split(self._waiting[name], tick)) for name in _SAMPLES}
        return Epoch(
            tick=tick, image=images[-1] if images else None, fix=fixes[-1] if fixes else None,
            **samples,
        )  # fmt: skip


def _split(messages: list[Any], tick: int) -> list[Any]:
    """Removes and returns those measured at or before ``tick``, oldest first."""
    due = sorted((m for m in messages if m.tick <= tick), key=lambda m: m.tick)
    messages[:] = [m for m in messages if m.tick > tick]
    return due
