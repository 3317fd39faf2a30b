"""The rows of the card, in their order."""

from functools import partial

from touchdown.experiments.gap import motion, world
from touchdown.experiments.gap.card import Row

ROWS = (
    Row(
        name="vibration in flight", x="Hz, six axes", y="log10 of rms, rad/s and m/s²",
        source="four IMUs on a DJI Phantom 4 (Hurwitz and Klein 2023)", tuned=True,
        changed="levels of `imu.vibration_*`", measure=motion.vibration,
    ),
    Row(
        name="turning of the vehicle", x="Hz", y="log10 of rms, rad/s",
        source="two of these flights, straight lines, four IMUs each", tuned=False,
        changed="nothing", measure=motion.turning,
        explained="our surveys are smoother between 1 and 7 Hz: the autopilot is another, and our "
        "gusts lack this part (see there)",
    ),
    Row(
        name="acceleration of the vehicle", x="Hz", y="log10 of rms, m/s²",
        source="the same two flights", tuned=False, changed="nothing", measure=motion.pushing,
        explained="our surveys are smoother between 1 and 4 Hz, where our gusts lack energy (see "
        "there) and the autopilot is another; the rise beyond 4 Hz is vibration",
    ),
    Row(
        name="IMU at rest", x="s, averaging time", y="log10 of the Allan deviation, rad/s and m/s²",
        source="ADIS16448 of EuRoC V1_01, and our model with its data sheet", tuned=False,
        changed="nothing", bound=0.15, measure=motion.at_rest,
        explained="0.2 s before the motors start is all that there is",
    ),
    Row(
        name="texture of images", x="px, period", y="log10 of the share of the variance",
        source="photographs from a multirotor (OpenDroneMap odm_data_caliterra)", tuned=False,
        changed="nothing", measure=world.texture,
        explained="our images hold more below periods of 8 px: the photographs were reduced to "
        "1600 px and compressed, ours show the camera's own pixels with their noise",
    ),
    Row(
        name="edges of images", x="percentile", y="log10 of the gradient over the deviation",
        source="the same photographs", tuned=False, changed="nothing", measure=world.edges,
        explained="for the same reason as texture, and our ground has less contrast over large "
        "areas than fields of different crops",
    ),
    Row(
        name="terrain", x="m, wavelength", y="log10 of the variance, m²",
        source="surface model with trees and buildings (NCALM, 1 m)", tuned=False,
        changed="nothing", measure=world.terrain,
    ),
    Row(
        name="scan patterns", x="s, of three LIDARs", y="share of the view's cells that are hit",
        source="directions in the wheel of mujoco-lidar", tuned=True,
        changed="turning rates and wedges of the prisms", bound=0.03, measure=world.patterns,
    ),
    Row(
        name="intensity of returns", x="percentile", y="log10 of 1 + intensity",
        source="percentiles of two Livox clouds (livox_detection, fast-lio-mid360)", tuned=False,
        changed="nothing", bound=0.3, measure=world.intensities,
        explained="the clouds are of a street and of a map, with dark and grazing surfaces; ours "
        "of grass and paths from above, which are bright in the near infrared. No cloud with "
        "intensities from the air was at hand",
    ),
    Row(
        name="gusts of `field`", x="reduced frequency", y="log10 of f S(f) / u*²",
        source="Kaimal's spectrum (1972) over the neutral surface layer", tuned=False,
        changed="nothing", bound=0.3, measure=world.gusts,
        explained="Dryden's forms (MIL-F-8785C) fall with the square of the frequency, air with "
        "its power 5/3: at wavelengths of 15 m our gusts have a tenth of the energy",
    ),
    Row(
        name="gusts of `harsh`", x="reduced frequency", y="log10 of f S(f) / u*²",
        source="the same spectrum", tuned=True, changed="`wind.short_waves`", bound=0.3,
        measure=partial(world.gusts, short_waves=True),
    ),
)  # fmt: skip
WITHOUT_DATA = ("gusts of `field`", "gusts of `harsh`")
"""names of rows that a formula stands in for recordings of"""
