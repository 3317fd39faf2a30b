"""Which runs a new one may replace in its directory."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.settings import NAMED, difference_text, identity_of, settings_of
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.results import load_result
from touchdown.experiments.io.run_directory import SENSORS_FILE

_REMEDY = "name another directory with --out, or give --force"


def check_kept(out_dir: Path, config: Config, *, force: bool, replayed: Path | None = None) -> None:
    """Raises UsageError where a run of another configuration would be replaced, or a sensor log,
    which may be what other commands count on, by a run without one. ``replayed``: the run whose
    sensors are replayed into ``out_dir``."""
    if force:
        return
    logs = config.log.sensors and replayed is None
    if not logs and (out_dir / SENSORS_FILE).is_file():
        raise UsageError(
            f"'{out_dir}' holds {SENSORS_FILE}, and this run would replace it without one; "
            f"{_REMEDY}"
        )
    new = identity_of(config) | ({} if replayed is None else {"replay_of": str(replayed)})
    earlier = _earlier(out_dir)
    if earlier is not None and (apart := difference_text(earlier, new)):
        raise UsageError(f"'{out_dir}' holds a run of another configuration: {apart}; {_REMEDY}")


def _earlier(run: Path) -> Mapping[str, Any] | None:
    """`identity_of` the configuration of a run that is there; None without one."""
    try:
        result = load_result(run / "result.json")
        settings = result.settings_set
        if settings is None:  # of an earlier version
            settings = settings_of(load_config(run / "config.json", allow_code=True))
    except UsageError:
        return None
    told = {key: getattr(result, key) for key in (*NAMED, "replay_of")}
    return {key: value for key, value in told.items() if value is not None} | settings
