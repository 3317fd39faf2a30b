"""When a flight reached the phases and heights at which faults begin."""

import math
from collections.abc import Iterable

from touchdown.sim.faults.types import Fault

_SINKING = frozenset(("descend", "return"))


class Marks:
    """Ticks of the marks of some faults, `NEVER` before they are reached."""

    NEVER = math.inf

    def __init__(self, faults: Iterable[Fault], tick_hz: int) -> None:
        self._ticks = {fault.mark: Marks.NEVER for fault in faults if fault.mark}
        self._heights = {mark: float(mark[:-1]) for mark in self._ticks if mark.endswith("m")}
        self._tick_hz = tick_hz

    @property
    def any(self) -> bool:
        """True where a fault waits for a mark, reached or not."""
        return bool(self._ticks)

    def follow(self, tick: int, phase: str, height_m: float) -> None:
        """Takes over phase and height of the legs over the site, metres, at ``tick``. A height is
        reached on the way down alone."""
        name = phase.lower()
        for mark, reached in self._ticks.items():
            if reached != Marks.NEVER:
                continue
            limit = self._heights.get(mark)
            low = limit is not None and name in _SINKING and height_m <= limit
            if low or name == mark:
                self._ticks[mark] = tick

    def began_s(self, fault: Fault) -> float | None:
        """When a fault began; None before its mark is reached."""
        start, _ = self.span(fault)
        return None if start == Marks.NEVER else start / self._tick_hz

    def span(self, fault: Fault) -> tuple[float, float]:
        """First tick of a fault, and the one after its last; infinite for never."""
        hz = self._tick_hz
        start = self._ticks[fault.mark] if fault.mark else round(fault.start_s * hz)
        if fault.duration_s is None:
            return start, math.inf
        return start, start + max(1, round(fault.duration_s * hz))
