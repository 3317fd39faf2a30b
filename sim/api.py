"""Public interface of the simulated world: messages, parameters, protocols.

Every array is float64 unless stated. Time is an integer count of ticks of ``SimParams.tick_hz``;
``time_s`` is ``tick / tick_hz``, but in the stamps of a `CameraImage`. Arrays inside messages are
read-only.
"""

from dataclasses import dataclass, field, fields
from typing import Annotated, Protocol

import numpy as np
from annotated_types import Interval

from touchdown.sim.faults.types import FAULT_KINDS as FAULT_KINDS
from touchdown.sim.faults.types import Fault as Fault
from touchdown.sim.faults.types import FaultParams as FaultParams
from touchdown.sim.frames import Pose
from touchdown.sim.navigation.types import BarometerParams as BarometerParams
from touchdown.sim.navigation.types import BarometerSample as BarometerSample
from touchdown.sim.navigation.types import BarometerSheet as BarometerSheet
from touchdown.sim.navigation.types import GpsFix as GpsFix
from touchdown.sim.navigation.types import GpsParams as GpsParams
from touchdown.sim.navigation.types import GpsPreset as GpsPreset
from touchdown.sim.navigation.types import GpsSheet as GpsSheet
from touchdown.sim.navigation.types import MagnetometerParams as MagnetometerParams
from touchdown.sim.navigation.types import MagnetometerSample as MagnetometerSample
from touchdown.sim.navigation.types import NavParams as NavParams
from touchdown.sim.navigation.types import NavSheet as NavSheet
from touchdown.sim.navigation.types import RangefinderParams as RangefinderParams
from touchdown.sim.navigation.types import RangefinderSample as RangefinderSample
from touchdown.sim.params import CameraParams as CameraParams
from touchdown.sim.params import Count as Count
from touchdown.sim.params import CountOrZero as CountOrZero
from touchdown.sim.params import Fraction as Fraction
from touchdown.sim.params import Heading as Heading
from touchdown.sim.params import ImuParams as ImuParams
from touchdown.sim.params import ImuSheet as ImuSheet
from touchdown.sim.params import LampParams as LampParams
from touchdown.sim.params import LensModel as LensModel
from touchdown.sim.params import LidarParams as LidarParams
from touchdown.sim.params import LidarPreset as LidarPreset
from touchdown.sim.params import LidarSheet as LidarSheet
from touchdown.sim.params import NotNegative as NotNegative
from touchdown.sim.params import Positive as Positive
from touchdown.sim.params import VehicleErrorParams as VehicleErrorParams
from touchdown.sim.params import parameters as parameters
from touchdown.sim.typing import Array, Bytes, Float32

GRAVITY_MPS2 = 9.81
AIR_DENSITY_KGPM3 = 1.225


@parameters
class SimParams:
    """Clock and delivery. All ``*_ticks`` divide or multiply one tick of 1 / ``tick_hz`` s."""

    tick_hz: Count = 600
    """physics steps a second, 500 or more; every other rate divides it"""
    control_ticks: Count = 3
    """Ticks between two controller commands (200 Hz)."""
    imu_ticks: Count = 3
    """ticks between two IMU samples (200 Hz)"""
    camera_ticks: Count = 20
    """The camera's own clock (30 Hz); images are rendered on its pulses."""
    lidar_scan_ticks: Count = 60
    """ticks of one LIDAR scan (10 Hz)"""
    compute_latency_ticks: CountOrZero = 36
    """Time from the end of a scan, or the exposure of an image, until an estimator may use it."""
    latency_sigma: NotNegative = 0.0
    """Spread of that time from message to message: standard deviation of its natural logarithm,
    about the median ``compute_latency_ticks``. 0: always the same."""
    latency_by_load: bool = False
    """that time is what one computer works on a message, and scans and images wait for one another;
    what would wait for more than 0.2 s is lost"""
    battery_capacity_j: Positive = 700e3
    """Usable energy at take-off (about 195 Wh)."""
    battery_sag: bool = False
    """the voltage falls with charge and load, and the highest rotor speed with it"""
    battery_resistance_ohm: NotNegative = 0.025
    """resistance of cells and leads, with ``battery_sag``"""
    threads: Annotated[int, Interval(ge=1, le=2)] = 2
    """2: rendering and ray casting overlap with each other and with everything else; 1: all of it
    in the calling thread.
    Both give the same result to the bit."""


@parameters
class WindParams:
    """Mean wind with a logarithmic profile, and Dryden low-altitude turbulence (MIL-F-8785C)."""

    mean_kmh: NotNegative = 12.0
    """Mean speed at 20 ft (6.1 m); also W20 of the Dryden model."""
    direction_deg: Heading | None = None
    """Direction that the wind blows to, counter-clockwise from east; None: by seed."""
    roughness_length_m: Annotated[float, Interval(gt=0.0, lt=6.0)] = 0.1
    """roughness length of the logarithmic profile"""
    turbulence: bool = True
    """add Dryden turbulence to the mean wind"""
    rotational: bool = False
    """add the rotational gusts of the Dryden model, which turn the vehicle"""
    wakes: bool = False
    """slow the wind and make it more turbulent behind buildings and trees"""
    short_waves: bool = False
    """turbulence of the same strength with the short waves that Dryden's forms lack: its energy
    falls with the power 5/3 of the frequency, not with its square"""


@parameters
class DustParams:
    """Dust that the rotors' downwash raises from bare, loose ground."""

    density: NotNegative = 0.0
    """dust in the air, over that of dry, bare soil; 0: none"""


@dataclass(frozen=True, kw_only=True, slots=True)
class WorldParams:
    """Every parameter of the simulated world but its scene and its seed."""

    sim: SimParams = field(default_factory=SimParams)
    wind: WindParams = field(default_factory=WindParams)
    lidar: LidarParams = field(default_factory=LidarParams)
    camera: CameraParams = field(default_factory=CameraParams)
    lamp: LampParams = field(default_factory=LampParams)
    imu: ImuParams = field(default_factory=ImuParams)
    nav: NavParams = field(default_factory=NavParams)
    faults: FaultParams = field(default_factory=FaultParams)
    vehicle_error: VehicleErrorParams = field(default_factory=VehicleErrorParams)
    dust: DustParams = field(default_factory=DustParams)


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraIntrinsics:
    """Pinhole with OpenCV's five distortion coefficients (k1, k2, p1, p2, k3), or its fisheye with
    four (k1, k2, k3, k4, and 0); pixel centres at integer coordinates."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Array = field(default_factory=lambda: np.zeros(5))
    lens: LensModel = "pinhole"

    def matrix(self) -> Array:
        """K, (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, kw_only=True, slots=True)
class VehicleModel:
    """The airframe's parameters, as the flight controller uses them. Rotor i at ``rotor_xy_m[i]``
    (body frame) gives thrust ``thrust_coefficient * w**2`` along body +z and the yaw torque
    ``rotor_spin[i] * torque_coefficient * w**2`` about body +z."""

    mass_kg: float
    inertia_kgm2: Array
    """(3,) principal moments about the centre of mass, body axes."""
    rotor_xy_m: Array
    """(R, 2)"""
    rotor_spin: Array
    """(R,) of +1 or -1"""
    thrust_coefficient: float
    """N / (rad/s)^2"""
    torque_coefficient: float
    """N m / (rad/s)^2"""
    rotor_speed_min: float
    """rad/s, idle"""
    rotor_speed_max: float
    """rad/s"""
    motor_time_constant_s: float
    linear_drag: float
    """N per m/s of air-relative velocity in the rotor plane, all rotors at hover."""
    leg_height_m: float
    """Distance from the underside of the legs to the body origin."""
    footprint_radius_m: float
    """Horizontal radius of the circle that holds rotors and legs."""
    rotor_inflow: float = 0.0
    """N / ((rad/s)(m/s)): thrust that one rotor loses to flow along its axis; 0: unknown."""
    quadratic_drag: float = 0.0
    """N / (m/s)^2 of everything but the rotors; 0: unknown."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SensorRig:
    """Sensor calibration, rates and data sheets as given to an estimator, without parameters of the
    simulation. ``world_from_body_start`` is the known take-off pose: all of it, or position and
    heading, see ``start_tilt_sigma_rad``. Extrinsics map sensor coordinates to body coordinates."""

    tick_hz: int
    body_from_imu: Pose
    body_from_lidar: Pose
    body_from_camera: Pose
    body_from_camera_right: Pose
    camera: CameraIntrinsics
    lidar: LidarSheet
    imu: ImuSheet
    imu_ticks: int
    camera_ticks: int
    lidar_scan_ticks: int
    compute_latency_ticks: int
    world_from_body_start: Pose
    vehicle: VehicleModel
    nav: NavSheet = field(default_factory=NavSheet)
    start_tilt_sigma_rad: float = 0.0
    """standard deviation of the true roll and pitch at take-off about those of
    ``world_from_body_start``, which are 0 then; 0: they are known"""
    start_velocity_mps: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) of the body at the start, world frame"""
    start_velocity_sigma_mps: float = 0.0
    """standard deviation of that, beside that of a vehicle on its legs"""
    camera_readout_s: float = 0.0
    """nominal time from the exposure of an image's first row to that of its last"""


def divisors(number: int) -> str:
    """The divisors of a number, for messages."""
    return ", ".join(str(i) for i in range(1, number + 1) if number % i == 0)


@dataclass(frozen=True, kw_only=True, slots=True)
class SensorNeeds:
    """Sensors that a component needs. The world simulates the union of all needs and nothing else.
    The IMU always runs."""

    camera_hz: int = 0
    """0: no images; else a divisor of the camera's clock rate (30, 15, 10, 6, 5, 3, 2, 1)."""
    stereo: bool = False
    lidar: bool = False
    gps: bool = False
    barometer: bool = False
    magnetometer: bool = False
    rangefinder: bool = False

    def __or__(self, other: "SensorNeeds") -> "SensorNeeds":
        names = (field.name for field in fields(self))
        return SensorNeeds(
            **{name: max(getattr(self, name), getattr(other, name)) for name in names}
        )

    def check_camera_rate(self, clock_hz: int) -> None:
        """Raises ValueError, with the allowed values, unless images fall on pulses of a camera's
        clock."""
        rate = self.camera_hz
        if not isinstance(rate, int | np.integer) or rate < 0 or (rate and clock_hz % rate):
            raise ValueError(
                f"camera_hz is {rate}, but images come on pulses of a {clock_hz} Hz clock: 0 or "
                f"one of {divisors(clock_hz)}"
            )


@dataclass(frozen=True, kw_only=True, slots=True)
class ImuSample:
    """Mean over the ``imu_ticks`` before ``tick`` (an integrating IMU), IMU frame."""

    tick: int
    time_s: float
    angular_velocity: Array
    """(3,) rad/s"""
    specific_force: Array
    """(3,) m/s^2; +g along the upward axis at rest."""


def _seal(message: object, *names: str) -> None:
    """Makes a message's arrays read-only: several read them, and kernels compile for one type."""
    for name in names:
        array = getattr(message, name)
        if isinstance(array, np.ndarray) and array.flags.writeable:
            view = array.view()
            view.flags.writeable = False
            object.__setattr__(message, name, view)


@dataclass(frozen=True, kw_only=True, slots=True)
class LidarScan:
    """All pulses fired in (``start_tick``, ``end_tick``], LIDAR frame, each cast from the pose of
    its own instant. A pulse without return has range 0."""

    start_tick: int
    end_tick: int
    start_time_s: float
    end_time_s: float
    directions: Float32
    """(N, 3) nominal unit beam directions (angle noise is not in them)."""
    ranges: Float32
    """(N,) metres; 0 where there was no return."""
    time_offsets: Float32
    """(N,) seconds after ``start_time_s``, ascending."""
    intensity: Bytes
    """(N,) return strength 0..255, calibrated to reflectivity in percent below 150 (Livox)."""

    def __post_init__(self) -> None:
        _seal(self, "directions", "ranges", "time_offsets", "intensity")

    @property
    def points(self) -> Float32:
        """(N, 3) float32 metres; (0, 0, 0) where there was no return."""
        return self.directions * self.ranges[:, None]


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraImage:
    """One exposure. The stamp ``time_s`` is what the camera's driver wrote: the time at which the
    middle of the last row's exposure seemed to be, which may lie beside a tick and be late
    (``CameraParams.stamp_delay_s``, ``stamp_jitter_s``). ``tick`` is the tick nearest to it. With a
    rolling shutter the first row is exposed ``SensorRig.camera_readout_s`` earlier than the last,
    with a global one all rows are exposed at once."""

    tick: int
    time_s: float
    """s; ``tick / tick_hz`` where stamps are exact"""
    rgb: Bytes
    """(H, W, 3)"""
    right_rgb: Bytes | None = None
    """(H, W, 3), only where stereo was asked for."""

    def __post_init__(self) -> None:
        _seal(self, "rgb", "right_rgb")


@dataclass(frozen=True, kw_only=True, slots=True)
class Observation:
    """Messages that have arrived since the previous observation, oldest first."""

    tick: int
    time_s: float
    imu: tuple[ImuSample, ...] = ()
    scans: tuple[LidarScan, ...] = ()
    images: tuple[CameraImage, ...] = ()
    gps: tuple[GpsFix, ...] = ()
    barometer: tuple[BarometerSample, ...] = ()
    magnetometer: tuple[MagnetometerSample, ...] = ()
    rangefinder: tuple[RangefinderSample, ...] = ()
    rotor_speed_radps: Array
    """(R,) speed-controller telemetry of now."""
    battery_fraction: float
    """Usable energy left, 1 at take-off."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Command:
    """Demanded rotor speeds, (R,) rad/s; 0 switches a motor off."""

    rotor_speed_radps: Array
    events: tuple[str, ...] = ()
    """Messages of the controller since its last command, for the result."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Contact:
    """One touching pair. ``part``: ``leg``, ``rotor`` or ``body``; ``other``: the scene geom."""

    part: str
    other: str
    normal_force_n: float
    point_world: tuple[float, float, float] | None = None
    """metres, where they press hardest; None where it is not known"""


@dataclass(frozen=True, kw_only=True, slots=True)
class MovingFrame:
    """Pose and motion of a body in the world."""

    world_from_frame: Pose
    velocity_world: Array
    """(3,) m/s of its origin"""
    angular_velocity_world: Array
    """(3,) rad/s"""

    def velocity_at(self, point_world: Array) -> Array:
        """(3,) m/s of a point (3,) that is fixed to it."""
        arm = point_world - self.world_from_frame.translation
        return np.asarray(self.velocity_world + np.cross(self.angular_velocity_world, arm))


@dataclass(frozen=True, kw_only=True, slots=True)
class Truth:
    """The true state, for the recorder, the referee and the ``oracle`` estimator only."""

    tick: int
    time_s: float
    world_from_body: Pose
    velocity_world: Array
    """(3,) m/s of the body origin"""
    acceleration_world: Array
    """(3,) m/s^2, mean over the last control step, gravity not included"""
    angular_velocity_body: Array
    """(3,) rad/s"""
    wind_world: Array
    """(3,) m/s, mean and turbulence"""
    rotor_speed_radps: Array
    """(4,)"""
    contacts: tuple[Contact, ...]
    peak_contact_accel: float
    """m/s^2, largest |acceleration| of any tick of the last control step"""
    energy_used_j: float
    living_world: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(N, 3) where people, riders and animals stand"""
    intruders_world: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(M, 3) those of them whom a fault has sent"""
    deck: MovingFrame | None = None
    """what moves and can be landed on; None where nothing does"""


class World(Protocol):
    """The simulated world, as the main loop uses it."""

    rig: SensorRig

    def reset(self) -> Observation: ...

    def step(self, command: Command) -> Observation:
        """Advances ``control_ticks`` and returns what arrived meanwhile."""
        ...

    def truth(self) -> Truth: ...

    def follow(self, phase: str, site_world: Array | None) -> None:
        """Tells the phase of the mission and the site (3,) that is landed on, None without one, to
        what begins at a phase or at a height over the site."""

    def take_textures(self) -> None:
        """Frees the memory that the scene has for its textures: nobody else can draw it then."""

    def close(self) -> None: ...
