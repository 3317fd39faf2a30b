"""A fuzzed command, and the verdict on its end.

A case is a command line in a folder of its own. It may end in three ways: it is done (exit code 0
or 1), it is refused (exit code 2: one line on stderr, nothing written), or it reaches the beginning
of the long work, where `fuzz.grounding` ends it. Any other end is a finding.
"""

import hashlib
import os
import re
import stat
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

REACHED = 77
"""Exit code of a command that `fuzz.grounding` has ended."""
MAX_LINE = 1000
"""Greatest number of characters of an error message."""
_ERROR, _WARNING = "touchdown: error: ", "touchdown: warning: "
_MAX_WARNINGS = 3
_MAY_STAY = ("results.parquet", "reproduction.json", ".lock")
"""A table over runs may be made anew at any time, a lock holds nothing, and the mark of a
reproduction is what the same command goes on from."""
_CACHES = ("home/.cache/matplotlib", "home/.config/matplotlib", "home/.cache", "home/.config")
"""What libraries keep for themselves: a list of fonts."""
_HALF = re.compile(r"\.partial|\.flying|\.tmp$|(^|/)tmp[a-z0-9_]{8}($|/)")
_CLASS_NAME = re.compile(r"\b[A-Za-z_.]*[a-z]Error\b|\bErrno\b|<class |object at 0x")


@dataclass(frozen=True, kw_only=True, slots=True)
class Case:
    """``arguments`` of the command line; the files are there already. ``writes``: paths that a
    command that is done may write to, "*" for any."""

    arguments: tuple[str, ...]
    writes: tuple[str, ...] = ()
    noisy: bool = False
    """its progress stands on stderr"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Verdict:
    """``code`` is the exit code, ``reached``, or the signal that ended it; ``faults`` lists the
    violated rules."""

    kind: str
    number: int
    arguments: tuple[str, ...]
    code: int | str
    error: str
    faults: tuple[str, ...]
    wall_s: float
    cpu_s: float
    memory_mb: int
    text: str = field(default="", compare=False)
    """the end of stderr, of a finding"""


def judge(
    code: int | str, errors: str, output: str, *, as_data: bool = False, noisy: bool = False
) -> list[str]:
    """Returns the faults of an exit code and of the texts on stderr and stdout. ``as_data``: what
    stdout holds is for a file, with all characters as they are; ``noisy``: see `Case`."""
    faults = []
    if code not in (0, 1, 2, "reached"):
        faults.append(f"exit code {code}")
    if "Traceback (most recent call last)" in errors + output:
        faults.append(f"a traceback: {last_frame(errors)}")
    for name, text in (("stderr", errors), ("stdout", "" if as_data else output)):
        if "\x1b" in text or "\x9b" in text:
            at = max(text.find("\x1b"), text.find("\x9b"))
            faults.append(f"ESC on {name}: {text[max(at - 80, 0) : at + 40]!r}")
    lines = [line for line in errors.split("\n") if line.strip()]
    warned = [line for line in lines if line.startswith(_WARNING)]
    if len(warned) > _MAX_WARNINGS:
        faults.append(f"{len(warned)} warnings: {warned[0][:300]}")
    foreign = [line for line in lines if not line.startswith("touchdown: ")]
    if foreign and not noisy and not faults:
        faults.append(f"a foreign line on stderr: {foreign[0][:300]!r}")
    said = [line.removeprefix(_ERROR) for line in lines if line.startswith(_ERROR)]
    if code == 2 and len(said) != 1 and not faults:
        faults.append(f"{len(said)} lines of error: {errors[:1000]!r}")
    if code in (0, 1) and said:
        faults.append(f"exit code {code} with an error: {said[0][:300]}")
    return faults + [fault for line in said for fault in message_faults(line)]


def last_frame(errors: str) -> str:
    """Where the last traceback ends, and with what."""
    frames = re.findall(r'File "([^"]+)", line (\d+), in (\S+)', errors)
    ours = [f for f in frames if "site-packages" not in f[0] and "/usr/" not in f[0]]
    place = "?"
    if ours or frames:
        path, line, name = (ours or frames)[-1]
        place = f"{'/'.join(path.split('/')[-3:])}:{line} {name}"
    last = [line for line in errors.rstrip().split("\n") if line.strip()]
    return f"{place}: {last[-1][:300] if last else ''}"


def message_faults(text: str) -> list[str]:
    """Returns the faults of an error message."""
    faults = []
    if len(text) < 12:
        faults.append(f"empty message: {text!r}")
    if len(text) > MAX_LINE:
        faults.append(f"{len(text)} characters of error: {text[:300]!r}")
    if not all(character.isprintable() for character in text):
        faults.append(f"control characters in the error: {text[:300]!r}")
    if _CLASS_NAME.search(text):
        faults.append(f"a class name in the error: {text[:300]!r}")
    return faults


def fingerprint(folder: str | os.PathLike[str]) -> dict[str, str]:
    """Every path below a folder, and a digest of every ordinary file."""
    found = {}
    for root, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = os.path.join(root, name)
            found[os.path.relpath(path, folder)] = _digest(path)
    return found


def _digest(path: str) -> str:
    try:
        kind = os.lstat(path).st_mode
        if stat.S_ISLNK(kind):
            return f"link to {os.readlink(path)}"
        if stat.S_ISDIR(kind):
            return "folder"
        if not stat.S_ISREG(kind):
            return "special"
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "md5").hexdigest()
    except OSError:
        return "unreadable"


def written(
    code: int | str, before: Mapping[str, str], after: Mapping[str, str], writes: Sequence[str]
) -> list[str]:
    """Returns the faults of the files that a case leaves; paths are relative to its folder."""
    new = sorted(path for path, digest in after.items() if before.get(path) != digest)
    lost = sorted(before.keys() - after.keys())
    halves = [path for path in new if _HALF.search(path) and path not in before]
    # the folder in which shards fly stays for the others, empty
    halves = [path for path in halves if after[path] != "folder" or not path.endswith(".partial")]
    faults = [f"half-written: {path}" for path in halves[:3]]
    new = [path for path in new if not path.endswith(_MAY_STAY) and ".lock" not in path]
    new = [path for path in new if path not in halves and not _is_cache(path)]
    if "*" in writes and code != 2:  # any command: pictures that came before the long work too
        new = [path for path in new if path in before]
    elif code not in (0, 1):  # like Ctrl-C: folders that are empty do no harm
        new = [path for path in new if after[path] != "folder" or code == 2]
    else:
        new = [path for path in new if not _within(path, writes)]
        lost = [path for path in lost if not _within(path, writes)]
    if new or lost:
        faults.append(f"exit code {code}, but it wrote {new[:5]} and took away {lost[:5]}")
    return faults


def _is_cache(path: str) -> bool:
    # torch makes the folder in which it would keep what it compiles, and compiles nothing.
    return path in _CACHES or path.startswith((*_CACHES[:2], "tmp/torchinductor_"))


def _within(path: str, writes: Sequence[str]) -> bool:
    return any(
        path == allowed or path.startswith(f"{allowed}/") or allowed.startswith(f"{path}/")
        for allowed in writes
    )
