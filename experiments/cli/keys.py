"""The command `touchdown config`."""

import json
from collections.abc import Mapping
from typing import Any

import click

from touchdown.experiments.cli.common import answered
from touchdown.experiments.errors import UsageError
from touchdown.experiments.terminal import say


def _show(figures: Mapping[str, Any]) -> None:
    for row in figures["keys"]:
        unit = f" {row['unit']}" if row["unit"] else ""
        other = row["ideal"] != row["default"]
        ideal = f"   (profile ideal: {_text(row['ideal'])})" if other else ""
        say(f"{row['key']} = {_text(row['default'])}{unit}{ideal}")
        say(f"    {row['meaning']}")


def _text(value: Any) -> str:
    return "none" if value is None else json.dumps(value, ensure_ascii=False)


@click.command("config")
@click.argument("prefix", default="")
@answered(_show)
def config(prefix: str) -> dict[str, Any]:
    """List the keys of a flight: default, unit, meaning.

    PREFIX is a group, such as `survey`, or the beginning of a key. A default is that of the profile
    `field`, which is flown where none is named.

    Example: touchdown config landing.wind
    """
    from touchdown.experiments.config.loading import default_values
    from touchdown.experiments.config.profiles import DEFAULT, KEY, profile_values
    from touchdown.experiments.config.ranges import unit_of
    from touchdown.experiments.config.reference import meaning_of, values_of
    from touchdown.experiments.config.suggestions import suggestion

    ideal = dict(default_values())
    flown = {**ideal, **profile_values(DEFAULT), KEY: DEFAULT}
    keys = [key for key in ideal if key.startswith(prefix)]
    if not keys:
        raise UsageError(f"no key begins with '{prefix}'{suggestion(prefix, ideal)}")
    units = {key: unit_of(key) for key in keys}
    return {"keys": [
        {"key": key, "default": flown[key], "ideal": ideal[key],
         "unit": unit.symbol if unit else "", "values": values_of(key).replace("`", ""),
         "meaning": meaning_of(key).replace("``", "")}
        for key, unit in units.items()
    ]}  # fmt: skip
