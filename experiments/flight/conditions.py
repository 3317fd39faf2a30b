"""Conditions of a flight, measured on the truth, on delivered messages and where the world applies
them, and verdicts: did what the configuration names happen in the flight? One rule for each.

Named are scheduled faults, light other than day, a mean wind other than the default, and the
effects of `harsh`: those of ``harsh_effects``, and in profile `harsh` all that do not depend on the
place of the landing.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from touchdown.experiments.config.profiles import effects
from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.estimator_calibration import calibration_errors
from touchdown.experiments.io.result_parts import Measured
from touchdown.experiments.recording.recorder import StepRecord
from touchdown.sim.api import FAULT_KINDS, Fault, Observation, SensorNeeds, SensorRig, WindParams
from touchdown.sim.effects import Effect, WorldRecord

REFERENCE_HEIGHT_M = 6.1
"""20 ft, at which the mean wind of a configuration is given"""
_AIRBORNE_M = 3.0
"""Height over the take-off spot from which wind and vibration count: below it the profile is steep
and the ground holds the vehicle still."""
_STRIDE = 16
"""step between the rows and columns whose brightness is taken"""
_NOTHING = Effect()


class ConditionsObserver:
    """Follows wind, vibration, brightness and latency; call ``tick`` with every control step."""

    def __init__(self, roughness_length_m: float) -> None:
        self._roughness_m = roughness_length_m
        self._start_z: float | None = None
        self._wind = self._profile = self._largest = 0.0
        self._steps = 0
        self._previous: list[float] | None = None
        self._shaken = self._rate = 0.0
        self._samples = 0
        self._grey: list[float] = [0.0, 0.0]
        self._latency = [0.0, 0.0, 0.0]

    def tick(self, step: StepRecord) -> None:
        """Takes one control step."""
        z = float(step.truth.world_from_body.translation[2])
        if self._start_z is None:
            self._start_z = z
        height = z - self._start_z
        if height > _AIRBORNE_M:
            self._air(step, height)
        else:
            self._previous = None
        self._messages(step.obs)

    def _air(self, step: StepRecord, height_m: float) -> None:
        # Scalars: arrays of three are slow at every control step.
        x, y, z = step.truth.wind_world.tolist()
        speed = math.hypot(x, y)
        self._steps += 1
        self._wind += speed
        self._profile += math.log(height_m / self._roughness_m) / math.log(
            REFERENCE_HEIGHT_M / self._roughness_m
        )
        self._largest = max(self._largest, math.hypot(speed, z))
        self._rate += math.hypot(*step.truth.angular_velocity_body.tolist())
        for sample in step.obs.imu:
            force = sample.specific_force.tolist()
            if self._previous is not None:
                self._shaken += math.dist(force, self._previous) ** 2
                self._samples += 1
            self._previous = force

    def _messages(self, obs: Observation) -> None:
        for image in obs.images:
            self._grey[0] += 1
            self._grey[1] += float(image.rgb[::_STRIDE, ::_STRIDE].mean())
        for scan in obs.scans:
            latency_ms = 1e3 * (obs.time_s - scan.end_time_s)
            for power in range(3):
                self._latency[power] += latency_ms**power

    def measured(self, record: WorldRecord, true: SensorRig, nominal: SensorRig) -> Measured:
        """Returns the figures of the flight. ``true``: the rig as it is, ``nominal``: as the
        estimator knows it."""
        steps, samples, images = (max(n, 1) for n in (self._steps, self._samples, self._grey[0]))
        scans, total, squares = self._latency
        latency = total / max(scans, 1)
        rate = self._rate / steps
        return Measured(
            wind_mps=self._wind / steps if self._steps else None,
            wind_at_6m_mps=self._wind / self._profile if self._steps else None,
            gust_mps=self._largest if self._steps else None,
            vibration_mps2=math.sqrt(self._shaken / 2.0 / samples) if self._samples else None,
            image_grey=self._grey[1] / images if self._grey[0] else None,
            scan_latency_ms=latency if scans else None,
            scan_latency_sigma_ms=(
                math.sqrt(max(squares / scans - latency**2, 0.0)) if scans else None
            ),
            readout_shear_px=true.camera.fx * true.camera_readout_s * rate if self._steps else None,
            **calibration_errors(true, nominal),
            **record.deviations,
            **_of_effects(record.effects),
        )


_AMOUNTS = {
    **{name: ("images", name) for name in (
        "light_lux", "exposure_ms", "gain", "exposure_error_stops", "stamp_error_ms",
    )},
    "range_error_m": ("scans", "ranging"), "wakes_mps": ("air", "wakes"),
    "air_rotation_degps": ("air", "rotation"),
}  # fmt: skip
"""Figures that are the mean amount of an effect: its stream and its name."""
_FRACTIONS = {"lamp_fraction": ("images", "lamp"), "plants_fraction": ("scans", "vegetation")}


def _of_effects(effects: Mapping[str, Mapping[str, Effect]]) -> dict[str, float | None]:
    scans, images = effects.get("scans", {}), effects.get("images", {})
    dusty, swayed = scans.get("dust", _NOTHING), scans.get("sway", _NOTHING)
    found: dict[str, float | None] = {}
    for table, figure in ((_AMOUNTS, "mean_amount"), (_FRACTIONS, "mean_fraction")):
        for column, (stream, name) in table.items():
            found[column] = getattr(effects.get(stream, {}).get(name), figure, None)
    return found | {
        "sway_m": swayed.amount / swayed.messages if swayed.messages else None,
        "dust_scans": float(dusty.messages),
        "dust_images": float(images.get("dust", _NOTHING).messages),
        "dust_returns_fraction": dusty.mean_fraction,
    }


MIN_FRACTION = 0.9
"""fraction of the messages, or of the time, that a lasting fault must have acted on. Not all: the
first message of a stream cannot repeat another, and another fault may have taken a message away."""
MAX_LUX: Mapping[str, float] = {"overcast": 25e3, "dusk": 1e3, "night": 1.0}
"""Most light (illuminance times reflectivity) of an image. Full daylight without direct sun has 10
to 25 klx, sunrise and sunset 400 lx, a full moon 0.05 to 0.3 lx."""
WIND_FRACTION = 0.35
"""fraction by which the mean over a flight may miss the mean wind: turbulence of a time scale of up
to half a minute does not average out in one or two"""
DRAWN_FRACTION = 0.2
"""fraction of its standard deviation or bound that a drawn error must have: three normal deviates
together are smaller in 0.2 % of flights"""
HALF = 0.5
"""fraction of what is asked for that an effect without chance must reach: `field` has half or less
of it"""
SUN_DEG = 1.0
"""angle by which a low sun may miss its elevation"""


@dataclass(frozen=True, slots=True)
class Condition:
    """The verdict on one condition of a flight."""

    name: str
    """name as the configuration gives it: ``camera_black@20``, ``night``, ``wind``, ``dust``"""
    happened: bool
    text: str
    """what was measured, in words"""
    value: float | None
    """the figure that decides; None: nothing measured it"""
    minimum: float | None = None
    maximum: float | None = None


OF_THE_PLACE = ("dust",)
"""Effects that profile `harsh` alone does not name: dust rises only where a vehicle hovers low over
bare soil, and few scenes have any."""


def named_conditions(config: Config) -> list[str]:
    """Returns the names of the conditions of a configuration."""
    return [
        *(fault.text for fault in config.faults.schedule()),
        *([config.light] if config.light != "day" else []),
        *(["wind"] if config.wind.mean_kmh not in (0.0, WindParams().mean_kmh) else []),
        *dict.fromkeys([*_of_profile(config), *config.harsh_effects]),
    ]


def _of_profile(config: Config) -> list[str]:
    if config.profile != "harsh":
        return []
    return [name for name in effects() if name not in OF_THE_PLACE]


def judge_conditions(
    config: Config, measured: Measured, faults: Sequence[Mapping[str, Any]], sim_s: float
) -> list[Condition]:
    """Returns the verdicts on the conditions of a flight of ``sim_s`` seconds, in the order of
    `named_conditions`; ``faults`` as in `sim.effects.WorldRecord`."""
    found = []
    for fault in config.faults.schedule():
        record = next((r for r in faults if fault.text in r["fault"].split(", ")), {})
        found.append(judge_fault(fault, record, sim_s, config))
    rules = {config.light: _light, "wind": _wind}
    for name in named_conditions(config)[len(found) :]:
        rule = rules.get(name)
        found.append(rule(config, measured) if rule else _effect(name, config, measured))
    return found


def as_json(conditions: Sequence[Condition]) -> list[dict[str, Any]]:
    """The form of ``result.json``: without the bounds that a condition lacks."""
    return [
        {key: value for key, value in asdict(one).items() if value is not None or key == "value"}
        for one in conditions
    ]


def judge_fault(fault: Fault, record: Mapping[str, Any], sim_s: float, config: Config) -> Condition:
    """The verdict on a fault by its record; in a flight of ``sim_s`` seconds."""
    if fault.mark:
        began_s = record.get("began_s")
        if began_s is None:
            text = f"{fault.kind} at {fault.mark}: the flight never got there"
            return Condition(fault.text, False, text, 0.0)
        fault = replace(fault, start_s=began_s)
    span = f"{fault.kind} {_span(fault)}"
    if fault.start_s >= sim_s:
        text = f"{span}: the flight ended at {sim_s:.1f} s, before it began"
        return Condition(fault.text, False, text, 0.0)
    if "sun_deg" in record:
        off = abs(record["sun_deg"] - config.faults.low_sun_deg)
        text = f"{span}: the sun is {record['sun_deg']:.1f} degrees high"
        return Condition(fault.text, off <= SUN_DEG, text, off, maximum=SUN_DEG)
    if "acted_s" in record:
        text = f"{span}: {record['acted_s']:.1f} s"
        if "gust_mps" in record:
            text += f", up to {record['gust_mps']:.1f} m/s"
        value, minimum = record["acted_s"], MIN_FRACTION * _due_s(fault, sim_s, config)
        return Condition(fault.text, value >= minimum > 0.0, text, value, minimum)
    messages, came = record.get("messages", {}), record.get("came", {})
    used = {stream: count for stream, count in came.items() if count}
    if not used:
        text = f"{span}: no message came that it could change"
        return Condition(fault.text, False, text, 0.0)
    text = f"{span}: " + ", ".join(f"{messages[s]} of {n} {s}" for s, n in used.items())
    if fault.count is not None:
        value, minimum = min(messages[stream] for stream in used), fault.count
    elif fault.kind in ("lens_dirt", "fog", "rain"):
        # each sensor sees it or not; weak air leaves ranges as they are
        value, minimum = max(messages[s] / n for s, n in used.items()), MIN_FRACTION
    else:
        value, minimum = min(messages[s] / n for s, n in used.items()), MIN_FRACTION
    return Condition(fault.text, value >= minimum, text + _change(record), value, minimum)


def _span(fault: Fault) -> str:
    if fault.duration_s is not None:
        return f"from {fault.start_s:.1f} to {fault.start_s + fault.duration_s:.1f} s"
    if fault.count is None:
        return f"from {fault.start_s:.1f} s"
    unit = "gust" if fault.kind == "gust" else "message"
    return f"from {fault.start_s:.1f} s, {fault.count} {unit}{'s' if fault.count > 1 else ''}"


def _due_s(fault: Fault, sim_s: float, config: Config) -> float:
    """Seconds for which a fault of the vehicle or the air is to act in a flight."""
    due = sim_s - fault.start_s
    gust_s = 2.0 * config.faults.gust_rise_s
    if fault.duration_s is not None:
        whole = gust_s * max(1, math.floor(fault.duration_s / gust_s + 1e-9))
        due = min(due, whole if fault.kind == "gust" else fault.duration_s)
    return due if fault.count is None else min(due, fault.count * gust_s)


def _change(record: Mapping[str, Any]) -> str:
    parts = []
    if "returns_changed" in record and record["came"].get("scans"):
        parts.append(f"{record['returns_changed']:.0%} of returns")
    if "grey_change" in record and record["came"].get("images"):
        parts.append(f"{record['grey_change']:.1f} grey levels")
    if "rotation_deg" in record:
        parts.append(f"{record['rotation_deg']:.2f} degrees")
    return f" ({', '.join(parts)})" if parts else ""


def _light(config: Config, measured: Measured) -> Condition:
    name, maximum, lux = config.light, MAX_LUX[config.light], measured.light_lux
    lamp = measured.lamp_fraction or 0.0
    text = "no image measured the light" if lux is None else f"{lux:.3g} lx without the lamp"
    dark = lux is not None and lux <= maximum
    if name == "night" and config.lamp.below_m > 0.0:
        text += f", the lamp on in {lamp:.0%} of images"
        dark = dark and lamp > 0.0
    return Condition(name, dark, f"{name}: {text}", lux, maximum=maximum)


def _wind(config: Config, measured: Measured) -> Condition:
    asked, found = config.wind.mean_kmh, measured.wind_at_6m_mps
    if found is None:
        return Condition("wind", False, "wind: the flight never left the ground", None)
    kmh = 3.6 * found
    low, high = (1.0 - WIND_FRACTION) * asked, (1.0 + WIND_FRACTION) * asked
    text = (
        f"wind of {asked:g} km/h: {kmh:.1f} km/h at 6 m, {3.6 * (measured.wind_mps or 0.0):.1f} at "
        f"the vehicle, gusts to {3.6 * (measured.gust_mps or 0.0):.1f}"
    )
    return Condition("wind", low <= kmh <= high, text, kmh, low, high)


@dataclass(frozen=True, slots=True)
class _Rule:
    """The figure of an effect must reach ``minimum`` of a configuration."""

    column: str
    unit: str
    minimum: Callable[[Config], float]


def _largest_error(*names: str) -> Callable[[Config], float]:
    return lambda c: DRAWN_FRACTION * max(getattr(c.calibration_error, name) for name in names)


def _latency(config: Config) -> float:
    """Half of the standard deviation of the log-normal latency, milliseconds."""
    median_ms = 1e3 * config.sim.compute_latency_ticks / config.sim.tick_hz
    growth = math.exp(config.sim.latency_sigma**2)
    return HALF * median_ms * math.sqrt((growth - 1.0) * growth)


EXPOSURE_STOPS_PER_S = 0.02
"""Least mean exposure error for each second of the control's time constant: a survey of `crossroad`
in `harsh`, with one second, has 0.07"""
MIN_SHEAR_PX = 0.1
"""Features are located to about a tenth of a pixel."""
MIN_PLANTS = 0.01
"""Fraction of returns: a scan's pattern varies by as much"""
MIN_SWAY_M = 0.001
"""a twentieth of the range noise"""
MIN_ROTATION_DEGPS = 0.5
"""the rotational gusts of a calm day of 3 m/s over a vehicle of half a metre"""
VIBRATION_MPS2 = 9.4
"""Vibration of a sensor on the airframe itself (a survey of `crossroad` in `harsh`), of which a
damped mount passes the fraction ``imu.vibration_isolation``"""

EFFECT_RULES: Mapping[str, _Rule] = {
    "latency": _Rule("scan_latency_sigma_ms", "ms of spread", _latency),
    "vehicle": _Rule(
        "center_of_mass_m", "m", lambda c: DRAWN_FRACTION * c.vehicle_error.center_of_mass_m
    ),
    "imu": _Rule("imu_scale", "of scale", lambda c: DRAWN_FRACTION * c.imu.scale_sigma),
    "vibration": _Rule(
        "vibration_mps2", "m/s^2", lambda c: HALF * VIBRATION_MPS2 * c.imu.vibration_isolation
    ),
    "lens": _Rule("lens_error_px", "px", _largest_error("center_sigma_px", "distortion_sigma_px")),
    "mounting": _Rule(
        "mount_error_deg",
        "degrees",
        _largest_error(
            "rotation_sigma_deg",
            "imu_camera_rotation_sigma_deg",
            "imu_lidar_rotation_sigma_deg",
        ),
    ),
    "shutter": _Rule("readout_shear_px", "px", lambda c: MIN_SHEAR_PX),
    "stamps": _Rule("stamp_error_ms", "ms", lambda c: HALF * 1e3 * c.camera.stamp_delay_s),
    "exposure": _Rule(
        "exposure_error_stops", "stops", lambda c: EXPOSURE_STOPS_PER_S * c.camera.exposure_lag_s
    ),
    "ranging": _Rule("range_error_m", "m", lambda c: DRAWN_FRACTION * c.lidar.range_bias_m),
    "vegetation": _Rule("plants_fraction", "of returns", lambda c: MIN_PLANTS),
    "sway": _Rule("sway_m", "m", lambda c: MIN_SWAY_M),
    "air": _Rule("air_rotation_degps", "degrees/s", lambda c: MIN_ROTATION_DEGPS),
    "dust": _Rule("dust_scans", "scans", lambda c: 1.0),
}
"""The rule of every group of `experiments.config.profiles.effects`."""


def _effect(name: str, config: Config, measured: Measured) -> Condition:
    rule = EFFECT_RULES[name]
    value, minimum = getattr(measured, rule.column), rule.minimum(config)
    found = "not measured" if value is None else f"{value:.3g} {rule.unit}"
    happened = value is not None and value >= minimum > 0.0
    return Condition(name, happened, f"{name}: {found}", value, minimum)


def inactive_faults(config: Config, needs: SensorNeeds) -> list[str]:
    """Returns one sentence for each scheduled fault without effect. ``needs``: sensors that
    estimator, mapper and lander read together."""
    read = {"scans": needs.lidar, "images": needs.camera_hz > 0, "gps": needs.gps}
    names = {"scans": "the LIDAR", "images": "the camera", "gps": "GPS"}
    sentences = []
    for fault in config.faults.schedule():
        streams = FAULT_KINDS[fault.kind]
        if not any(read.get(stream, True) for stream in streams):
            sensors = " or ".join(names[stream] for stream in streams)
            sentences.append(
                f"fault '{fault.text}' has no effect: neither estimator '{config.estimator}' "
                f"nor the map reads {sensors}"
            )
    return sentences
