"""The path of a flight as a plan of QGroundControl."""

from dataclasses import fields
from pathlib import Path

from touchdown.experiments.errors import UsageError
from touchdown.experiments.export.flown_run import Exported, ExportOptions, FlownRun, GeodeticPoint
from touchdown.experiments.export.ros2_bag import SITE_DEG
from touchdown.experiments.io.flight_plan import FlightPlan, geodetic, plan_of
from touchdown.experiments.io.tum import read_tum
from touchdown.experiments.io.untrusted import read_object
from touchdown.landing.api import SurveyParams
from touchdown.landing.mission.waypoints import survey_waypoints
from touchdown.sim.frames import Pose, matrices_from_quats_wxyz, yaw_from_rotation


def write_plan(flown: FlownRun, path: Path, options: ExportOptions) -> Exported:
    """Take-off, the corners of the survey, and the landing: at a commanded site or, for a flight
    that was to return, at home. Home is that of the plan that was flown, else ``options.origin`` is
    that of the world."""
    try:
        config = read_object(flown.file("config.json"))
        known = {one.name for one in fields(SurveyParams)}
        given = {key: value for key, value in config["survey"].items() if key in known}
        given["waypoints_m"] = tuple(map(tuple, given.get("waypoints_m", ())))
        survey = SurveyParams(**given)
        _, positions, quats = read_tum(flown.file("truth.tum"))
        start = Pose(matrices_from_quats_wxyz(quats[:1])[0], positions[0])
        places = survey_waypoints(yaw_from_rotation(start.rotation), survey)
        home = survey.home_wgs84
        if home is None:
            origin = options.origin or GeodeticPoint(*SITE_DEG, 0.0)
            home = (*geodetic(origin, start.translation[:2]), origin.height_m)
        site = config["landing"].get("site_xy_m")
        plan = FlightPlan(
            home_wgs84=(home[0], home[1], home[2]),
            waypoints_m=tuple((float(x), float(y), float(z)) for x, y, z in places),
            land_m=None
            if site is None
            else (site[0] - start.translation[0], site[1] - start.translation[1]),
            returns=bool(config["landing"].get("return_home")),
        )
        text = plan_of(plan)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise UsageError(f"'{flown.path}': its config.json describes no survey: {error}") from error
    path.write_text(text, encoding="utf-8")
    return Exported(path, {"waypoints": len(plan.waypoints_m)})
