"""Navigation sensors (GPS, barometer, magnetometer, rangefinder) at their own rates and delays."""

from typing import Generic, Protocol, TypeVar

import mujoco

from touchdown.scenes.api import Scene
from touchdown.sim import api
from touchdown.sim.delivery import DeliveryQueue, InlineExecutor
from touchdown.sim.frames import matrix_from_quat_wxyz
from touchdown.sim.lidar.surface_detail import SurfaceDetail
from touchdown.sim.navigation.rangefinder import RangefinderSensor
from touchdown.sim.navigation.sensors import BarometerSensor, GpsSensor, MagnetometerSensor
from touchdown.sim.typing import Array

T = TypeVar("T")


class _Timing(Protocol):
    @property
    def period_ticks(self) -> int: ...

    @property
    def latency_ticks(self) -> int: ...


class Channel(Generic[T]):
    """Schedule of one sensor, and its messages in transit."""

    def __init__(self, name: str, timing: _Timing, tick_hz: int, wanted: bool) -> None:
        if timing.period_ticks < 1 or tick_hz % timing.period_ticks:
            raise ValueError(
                f"{name}.period_ticks is {timing.period_ticks}, but it must divide sim.tick_hz "
                f"({tick_hz})"
            )
        self._period = timing.period_ticks if wanted else 0
        self._latency = timing.latency_ticks
        self._queue: DeliveryQueue[T] = DeliveryQueue(InlineExecutor())

    def due(self, tick: int) -> bool:
        """True where a measurement is taken at ``tick``."""
        return self._period > 0 and tick % self._period == 0

    def send(self, tick: int, sample: T) -> None:
        """``sample``, measured at ``tick``, arrives after the latency."""
        self._queue.submit(tick + self._latency, lambda: sample)

    def collect(self, tick: int) -> tuple[T, ...]:
        """Messages that have arrived by ``tick`` and were not collected yet, oldest first."""
        return self._queue.collect(tick)


class NavSensors:
    """The navigation sensors that ``needs`` names. Each has its own random numbers, so that none
    changes when another is added. The first measurement comes one period after tick 0.

    Raises ValueError for impossible parameters, those of sensors that are not needed included.
    """

    def __init__(
        self,
        scene: Scene,
        params: api.NavParams,
        sim: api.SimParams,
        needs: api.SensorNeeds,
        seed: int,
        plants: SurfaceDetail | None = None,
    ) -> None:
        hz = sim.tick_hz
        self._gps = GpsSensor(params.gps, hz, seed)
        self._barometer = BarometerSensor(params.barometer, hz, seed)
        self._magnetometer = MagnetometerSensor(params.magnetometer, hz, seed)
        self._rangefinder = RangefinderSensor(scene, params.rangefinder, hz, seed, plants)
        heard = needs.gps and self._gps.receives
        self.gps: Channel[api.GpsFix] = Channel("gps", params.gps, hz, heard)
        self.barometer: Channel[api.BarometerSample] = Channel(
            "barometer", params.barometer, hz, needs.barometer
        )
        self.magnetometer: Channel[api.MagnetometerSample] = Channel(
            "magnetometer", params.magnetometer, hz, needs.magnetometer
        )
        self.rangefinder: Channel[api.RangefinderSample] = Channel(
            "rangefinder", params.rangefinder, hz, needs.rangefinder
        )
        self.listening = heard or needs.barometer or needs.magnetometer or needs.rangefinder
        """True if any of them is needed"""

    def sense(
        self,
        tick: int,
        data: mujoco.MjData,
        position: Array,
        quat_wxyz: Array,
        velocity: Array,
        rates: Array,
    ) -> None:
        """Measures what is due at ``tick`` from the true pose (world_from_body), the world velocity
        (3,) m/s of the body origin and the body rates (3,) rad/s."""
        if self.barometer.due(tick):
            self.barometer.send(tick, self._barometer.sample(tick, float(position[2])))
        due = (self.gps.due(tick), self.magnetometer.due(tick), self.rangefinder.due(tick))
        if not any(due):
            return
        rotation = matrix_from_quat_wxyz(quat_wxyz)
        if due[0]:
            fix = self._gps.sample(tick, rotation, position, velocity, rates)
            self.gps.send(tick, fix)
        if due[1]:
            self.magnetometer.send(tick, self._magnetometer.sample(tick, rotation))
        if due[2]:
            echo = self._rangefinder.sample(tick, data, rotation, position)
            self.rangefinder.send(tick, echo)
