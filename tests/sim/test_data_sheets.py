"""What estimators are given: data sheets and a calibration, nothing of the simulation."""

from dataclasses import replace
from typing import Any

from touchdown.experiments.io.dataclass_json import to_plain
from touchdown.sim import api as sim
from touchdown.sim.world import MujocoWorld

from support.places import scene_of

SCENE_XML = """<mujoco><worldbody>
  <geom name="lawn_floor" type="plane" size="60 60 0.1"/><light pos="0 0 20"/>
</worldbody></mujoco>"""
SHEETS = {
    "lidar": "preset range_sigma_m angle_sigma_deg min_range_m max_range_m",
    "imu": "gyro_density accel_density gyro_bias_walk accel_bias_walk gyro_bias_sigma "
    "accel_bias_sigma scale_sigma misalignment_sigma_deg gyro_g_sensitivity gyro_range accel_range",
    "nav": "gps barometer magnetometer rangefinder",
    "gps": "period_ticks latency_ticks antenna_body_m",
    "barometer": "period_ticks latency_ticks white_sigma_pa offset_sigma_pa site_elevation_m",
    "magnetometer": "period_ticks latency_ticks strength_ut declination_deg inclination_deg "
    "noise_sigma_ut hard_iron_sigma_ut",
    "rangefinder": "period_ticks latency_ticks sigma_m resolution_m min_range_m max_range_m "
    "position_body_m",
}


def test_a_rig_holds_data_sheets_and_nothing_of_the_world(closed: Any) -> None:
    """Neither parameters of the simulation nor what is drawn from the seed."""
    scene = scene_of(SCENE_XML)
    stated = sim.ImuParams(scale_sigma=0.003, misalignment_sigma_deg=0.1, offset_m=(0.01, 0.0, 0.0))
    kind = sim.WorldParams(camera=sim.CameraParams(readout_s=0.015), imu=stated)
    harsh = sim.LidarParams(
        divergence=False, return_mode="strongest", pulse_length_m=0.1, range_bias_m=0.04,
        range_noise_growth=0.5, texture=1.0, vegetation=1.5, sway=2.0,
    )  # fmt: skip
    drift = sim.BarometerParams(drift_sigma_pa=9.0, drift_tau_s=9.0)
    unkind = replace(
        kind, lidar=harsh, imu=replace(stated, vibration_harmonics=1.0, vibration_isolation=0.2),
        nav=sim.NavParams(gps=sim.GpsParams(preset="denied", white_m=3.0), barometer=drift),
        camera=replace(kind.camera, exposure=True, stamp_delay_s=0.01, phase_s=0.01),
        wind=sim.WindParams(wakes=True), dust=sim.DustParams(density=1.0),
    )  # fmt: skip
    worlds = closed(MujocoWorld(scene, kind, 3)), closed(MujocoWorld(scene, unkind, 4))
    rig, other = (to_plain(world.rig) for world in worlds)
    assert rig == other and rig["camera_readout_s"] == 0.015
    assert rig["imu"]["scale_sigma"] == 0.003 and rig["lidar"]["range_sigma_m"] == 0.02
    assert rig["nav"]["gps"]["antenna_body_m"] == list(kind.nav.gps.antenna_body_m)
    for name, keys in SHEETS.items():
        assert set((rig | rig["nav"])[name]) == set(keys.split())
