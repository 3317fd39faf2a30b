"""The file of a trained network: ONNX with float16 weights, and its checksum file."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from touchdown.landing.classification.decision import Limits
from touchdown.landing.classification.labels import SCHEMES

SUFFIX = ".onnx"
INPUT, OUTPUT = "pictures", "scores"
_LIMIT_KEYS = {"min_probability": "least_probability", "min_energy": "least_energy"}
"""fields of ``Limits``, and their keys in a file"""


@dataclass(frozen=True, kw_only=True, slots=True)
class NetworkFacts:
    """Metadata of a network in its file."""

    network: str
    labels: str
    """a key of `landing.classification.labels.SCHEMES`"""
    image_size: int
    classes: tuple[str, ...]
    limits: Limits = field(default_factory=Limits)
    """limits at which a prediction counts as safe; fitted for ``d_land`` only"""
    miss_costs: tuple[tuple[str, float], ...] = ()
    """classes with the cost of a miss relative to any other error; 1 for classes left out"""

    def __post_init__(self) -> None:
        """Raises ValueError for the cost of an unknown class, or a cost that is not above 0."""
        for name, cost in self.miss_costs:
            if name not in self.classes:
                raise ValueError(
                    f"miss cost of '{name}': the classes are {', '.join(self.classes)}"
                )
            if not (cost > 0.0 and math.isfinite(cost)):
                raise ValueError(f"miss cost {cost:g} of '{name}': give a number above 0")

    def properties(self) -> dict[str, str]:
        """Returns the metadata as a file keeps them."""
        return {
            "network": self.network,
            "labels": self.labels,
            "image_size": str(self.image_size),
            "classes": " ".join(self.classes),
            "least_probability": repr(self.limits.min_probability),
            "least_energy": repr(self.limits.min_energy),
            "miss_costs": " ".join(f"{name}={cost!r}" for name, cost in self.miss_costs),
        }


def facts_of(properties: Mapping[str, str], path: Path) -> NetworkFacts:
    """Returns the inverse of ``NetworkFacts.properties``. Raises ValueError where something is
    missing."""
    try:
        facts = NetworkFacts(
            network=properties["network"],
            labels=properties["labels"],
            image_size=int(properties["image_size"]),
            classes=tuple(properties["classes"].split()),
            limits=Limits(
                **{
                    name: float(properties[key])
                    for name, key in _LIMIT_KEYS.items()
                    if key in properties
                }
            ),
            miss_costs=tuple(
                (name, float(cost))
                for name, _, cost in (
                    part.partition("=") for part in properties.get("miss_costs", "").split()
                )
            ),
        )
    except (KeyError, ValueError) as error:
        raise ValueError(f"'{path}' has no usable metadata: {error}") from error
    if SCHEMES.get(facts.labels) != facts.classes:
        raise ValueError(f"'{path}' has classes that are not those of '{facts.labels}'")
    return facts


def checksum_file(path: Path) -> Path:
    """Returns the path of the checksum of a network's file."""
    return path.with_name(path.name + ".sha256")


def write_network(path: Path, content: bytes) -> None:
    """Writes the network's file and its checksum, in the format of ``sha256sum``. In between the
    checksum is both that of an earlier file and of this one: each is valid at every moment."""
    line = f"{hashlib.sha256(content).hexdigest()}  {path.name}\n".encode()
    checksum = checksum_file(path)
    before = checksum.read_bytes() if checksum.is_file() and path.is_file() else b""
    for target, data in ((checksum, line + before), (path, content), (checksum, line)):
        partial = target.with_name(f".{target.name}.partial")
        partial.write_bytes(data)
        partial.replace(target)


def read_network(path: Path) -> bytes:
    """Returns the content of a network's file after a check of its checksum.

    Raises FileNotFoundError where the file or its checksum is missing, ValueError where they do not
    match: the file was truncated or changed.
    """
    if not path.is_file():
        raise FileNotFoundError(f"'{path}' does not exist; name a network, a file {SUFFIX}")
    if not checksum_file(path).is_file():
        raise FileNotFoundError(
            f"'{checksum_file(path)}' is missing: '{path.name}' is not loaded without it"
        )
    content = path.read_bytes()
    lines = checksum_file(path).read_text(encoding="utf-8", errors="replace").splitlines()
    checksums = [line.split()[0].lower() for line in lines[:2] if line.split()]
    if hashlib.sha256(content).hexdigest() not in checksums:
        raise ValueError(
            f"'{path}' ({len(content)} bytes) does not have the checksum in "
            f"'{checksum_file(path).name}': it is truncated or changed; copy it again"
        )
    return content
