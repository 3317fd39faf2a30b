"""The file of a trained network: ONNX with float16 weights, and its checksum file."""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from touchdown.landing.classification.decision import Limits
from touchdown.landing.classification.labels import SCHEMES
from touchdown.sim.files.opening import no_file

SUFFIX = ".onnx"
MAX_BYTES = 1 << 30
IMAGE_SIZES = (16, 512)
"""least and maximum side of a network's input, pixels"""
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
    missing or out of range."""
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
    except KeyError as error:
        raise ValueError(
            f"'{path}' has no usable metadata, it lacks {error}: give a file that "
            "`touchdown train` wrote"
        ) from error
    except ValueError as error:
        raise ValueError(f"'{path}' has no usable metadata: {error}") from error
    if not (facts.network.isprintable() and 0 < len(facts.network) <= 64):
        raise ValueError(f"'{path}' has a name of its network that is none: {facts.network[:64]!r}")
    minimum, maximum = IMAGE_SIZES
    if not minimum <= facts.image_size <= maximum:
        raise ValueError(
            f"'{path}' has the image_size {facts.image_size} in its metadata, not {minimum} to "
            f"{maximum}"
        )
    if math.isnan(facts.limits.min_energy) or not 0.0 <= facts.limits.min_probability <= 1.0:
        raise ValueError(f"'{path}' has limits in its metadata that are no numbers or no shares")
    if SCHEMES.get(facts.labels) != facts.classes:
        raise ValueError(f"'{path}' has classes that are not those of '{facts.labels}'")
    return facts


def checksum_file(path: Path) -> Path:
    """Returns the path of the checksum of a network's file."""
    return path.with_name(path.name + ".sha256")


def external_weights(path: Path) -> list[Path]:
    """Returns the files beside a network's file that hold its weights, after a check of their
    checksums, which are further lines of its checksum file. Raises ValueError where a file is
    missing, truncated or changed."""
    found = []
    for line in checksum_file(path).read_text(encoding="utf-8").splitlines():
        checksum, name = line.split(maxsplit=1)
        file = path.with_name(Path(name).name)
        if name == path.name:
            continue
        if not file.is_file() or hashlib.sha256(file.read_bytes()).hexdigest() != checksum:
            raise ValueError(f"'{file}', weights of '{path.name}', is missing or changed")
        found.append(file)
    return found


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
    if reason := no_file(path):
        raise FileNotFoundError(f"'{path}' {reason}; name a network, a file {SUFFIX}")
    if reason := no_file(checksum_file(path)):
        raise FileNotFoundError(
            f"'{checksum_file(path)}' {reason}: '{path.name}' is not loaded without it"
        )
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise ValueError(
            f"'{path}' has {size >> 20} MiB, more than {MAX_BYTES >> 20} MiB: give a file that "
            "`touchdown train` wrote"
        )
    content = path.read_bytes()
    with checksum_file(path).open(encoding="utf-8", errors="replace") as file:
        lines = file.read(1000).splitlines()
    checksums = [line.split()[0].lower() for line in lines[:2] if line.split()]
    if hashlib.sha256(content).hexdigest() not in checksums:
        raise ValueError(
            f"'{path}' ({len(content)} bytes) does not have the checksum in "
            f"'{checksum_file(path).name}': it is truncated or changed; copy it again"
        )
    return content
