import json
from pathlib import Path

import pytest

from touchdown.experiments.campaign.plan import load_plan
from touchdown.experiments.config.files import read_tree
from touchdown.experiments.config.keys import RENAMED
from touchdown.experiments.config.loading import dump_config, known_keys, load_config
from touchdown.experiments.config.ranges import choices_of, types_of_keys
from touchdown.experiments.config.slots import SLOTS
from touchdown.experiments.errors import UsageError

CONFIGS = Path(__file__).parents[3] / "configs"


def test_precedence_is_file_then_set_then_option(tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_text("seed = 1\n[wind]\nmean_kmh = 1\nturbulence = false\n[survey]\nlegs = 2\n")
    values = ["wind.mean_kmh=2", "seed=2", "scene=lake", 'estimator="oracle"']
    config = load_config(file, values, seed=3, wind_kmh=None)
    assert (config.scene, config.estimator) == ("lake", "oracle")
    assert (config.seed, config.wind.mean_kmh) == (3, 2.0) and not config.wind.turbulence
    assert config.survey.legs == 2


def test_resolved_configuration_can_be_fed_back(tmp_path: Path) -> None:
    config = load_config(None, ["bias.xy_m=[0.5, -0.25]"], site=(1.5, -2.0), wind_kmh=7.5)
    file = tmp_path / "config.json"
    file.write_text(dump_config(config))
    again = load_config(file)
    assert again == config and again.bias.xy_m == (0.5, -0.25)
    assert again.landing.site_xy_m == (1.5, -2.0) and dump_config(again) == dump_config(config)


@pytest.mark.parametrize(("override", "words"), [
    ("wind.mean_kph=3", ["wind.mean_kph", "did you mean 'wind.mean_kmh'"]),
    ("mean_kmh=3", ["did you mean 'wind.mean_kmh'"]),
    ("sim.imu_tick=3", ["did you mean 'sim.imu_ticks'"]),
    ("qqq=1", ["unknown key 'qqq'", "survey"]), ("wind=3", ["group", "wind.mean_kmh"]),
    ("wind.mean_kmh", ["form key=value"]), ("=3", ["form key=value"]),
    ("wind.mean_kmh=fast", ["wind.mean_kmh", "fast", "number"]),
    ("wind.turbulence=1", ["wind.turbulence", "boolean"]), ("seed=1.5", ["seed", "integer"]),
    ("scene=3", ["scene", "string"]),
    ("landing.site_xy_m=[1]", ["landing.site_xy_m"]),
    ("wind.mean_kmh=2020-01-01", ["wind.mean_kmh"]), ("wind.mean_kmh=nan", ["finite"]),
    ("bias.xy_m=[0.0, inf]", ["finite"]),
    ("wind.mean_kmh=-1", ["wind.mean_kmh = -1 in", "must be within 0 to 450"]),
    ("survey.height_m=-3", ["height_m = -3 in --set survey.height_m=-3 must be within"]),
    ("landing.max_slope_deg=90", ["must be above 0 and below 90"]),
    ("zou2024.planar_cells=[56, 0]", ["zou2024.planar_cells = [56, 0]", "within 1 to 10000"]),
    ("sim.threads=3", ["must be within 1 to 2"]),
    ("bias.xy_m=[0.0, -1e300]", ["bias.xy_m = [0.0, -1e+300]", "within -10000 to 10000"]),
    ("mapper.cell_m=0.01", ["mapper.extent_m = 160 over", "more than 2048 cells along"]),
    ("mapper.fine_extent_m=500", ["mapper.fine_extent_m = 500 over mapper.fine_cell_m"]),
    ("sim.camera_ticks=7", ["sim.camera_ticks", "must divide sim.tick_hz = 600"]),
    ("sim.lidar_scan_ticks=50", ["sim.lidar_scan_ticks", "multiple"]),
    ("livo.camera_hz=7", ["livo.camera_hz", "30 Hz"]),
    ("control.control_hz=100", ["control.control_hz", "200"]),
    ("survey.legs=5", ["does not fit into 36 s", "to 50 or more", "--set survey.legs=5"]),
    ("survey.legs=40", ["40 legs of 50 m does not fit into 36 s", "to 414 or more"]),
])  # fmt: skip
def test_mistakes_are_reported_in_one_line(override: str, words: list[str]) -> None:
    with pytest.raises(UsageError) as caught:
        load_config(None, [override])
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message
    assert load_config(None, ["survey.legs=5", "survey.duration_s=50"]).survey.legs == 5


def test_mistakes_in_a_file_name_the_file(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("[wind]\nmean_kph = 3\n")
    with pytest.raises(UsageError, match=r"wind\.mean_kph.*mine\.toml.*mean_kmh"):
        load_config(file)
    file.write_text("[wind\nmean_kmh = 3\n")
    with pytest.raises(UsageError, match=r"mine\.toml.*TOML.*line 1"):
        load_config(file)
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError, match=r"mine\.toml.*text"):
        load_config(file)
    with pytest.raises(UsageError, match=r"gone\.toml.*does not exist"):
        load_config(tmp_path / "gone.toml")


def test_one_fault_needs_no_brackets(tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_text("faults.events = 'gps_dropout@20'\n")
    for config in (load_config(file), load_config(None, ["faults.events=gps_dropout@20"])):
        assert config.faults.events == ("gps_dropout@20",)
    with pytest.raises(UsageError, match="unknown fault 'gps_drop' in 'gps_drop@20'"):
        load_config(None, ["faults.events=gps_drop@20"])


OPEN_NAMES = {
    "scene", "estimator", "vehicle", "rig", "external", "calibration", "scene_classes",
    "harsh_effects",
    "traffic.paths", "survey.path", "survey.trajectory", "landing.people_network", "faults.events",
    "variant", "zou2024.edge_model", "px4.path", "px4.parameters",
    *(slot.key for slot in SLOTS.values()),
}  # fmt: skip
"""Names beside paths, modules and forms with numbers: checked by what reads them."""


def test_closed_sets_of_names_refuse_others_when_they_are_read() -> None:
    """Every key of text is a closed set or known to be open."""
    types = types_of_keys()
    closed = {key for key, kind in types.items() if choices_of(kind)}
    assert {key for key, kind in types.items() if "str" in str(kind)} <= closed | OPEN_NAMES
    assert {"profile", "light", "lidar.preset", "lidar.return_mode", "gps.preset"} <= closed
    for key in sorted(closed):
        with pytest.raises(UsageError) as caught:
            load_config(None, [f"{key}=nonsense"])
        words = f'{key} = "nonsense" in --set {key}=nonsense is unknown'
        assert str(caught.value).startswith(words)
        assert str(caught.value).endswith(choices_of(types[key])[-1])


def test_names_of_earlier_versions_are_read_with_one_warning(tmp_path: Path) -> None:
    file = tmp_path / "config.json"
    old = {"livo.mount_turn_sigma_deg": 0.7, "paper.use_bundle": False}
    file.write_text(json.dumps({**old, "estimator": "paper", "gps.preset": "paper"}))
    with pytest.warns(UserWarning, match="earlier names") as told:
        config = load_config(file, ["livo.camera_turn_sigma_deg=0.1"])
    assert [str(one.message) for one in told] == [
        f"'{file}': earlier names: 'livo.mount_turn_sigma_deg' is "
        "'livo.mount_rotation_sigma_deg'; 'paper.use_bundle' is 'zou2024.use_bundle'; "
        "estimator = 'paper' is 'zou2024'; gps.preset = 'paper' is 'zou2024' now",
        "--set livo.camera_turn_sigma_deg=0.1: earlier names: 'livo.camera_turn_sigma_deg' is "
        "'livo.camera_rotation_sigma_deg' now",
    ]
    assert config.livo.mount_rotation_sigma_deg == 0.7 and not config.zou2024.use_bundle
    assert config.livo.camera_rotation_sigma_deg == 0.1
    assert (config.estimator, config.gps.preset) == ("zou2024", "zou2024")
    for old, new in RENAMED.items():
        assert old not in known_keys() and new in known_keys()


@pytest.mark.parametrize("file", sorted(CONFIGS.glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_configurations_load(file: Path) -> None:
    if "axes" in read_tree(file):
        load_plan(file)
    else:
        load_config(file)


def test_a_constant_is_left_out_of_a_run_s_configuration_and_refused_elsewhere(
    tmp_path: Path,
) -> None:
    file = tmp_path / "config.json"
    file.write_text('{"livo": {"map_voxels": 64}, "survey_fit": {"step_m": 1.0}, "seed": 3}')
    with pytest.warns(UserWarning, match=r"constants now, left out: livo.map_voxels, survey_fit"):
        assert load_config(file).seed == 3
    with pytest.raises(UsageError, match=r"'livo.map_voxels' in --set \S+ is a constant"):
        load_config(None, ["livo.map_voxels=64"])
