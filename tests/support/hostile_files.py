"""Files that declare more than they hold, or are no files."""

import os
import resource
import struct
import subprocess
import zlib
from pathlib import Path

from support.command import python

MEMORY_BYTES = 4 << 30
LIMIT_S = 600.0
"""Only ends what hangs: tests share the machine."""


def png(
    width: int, height: int, bits: int = 8, colour: int = 2, inflated: int = 1000,
    text: bytes = b"", methods: tuple[int, int, int] = (0, 0, 0), data: bytes = b"",
) -> bytes:  # fmt: skip
    """A PNG that declares a size and holds ``inflated`` bytes or ``data``, and a compressed
    ``text``. ``methods``: of compression, filters and interlacing."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", width, height, bits, colour, *methods)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + (chunk(b"zTXt", b"k\0\0" + text) if text else b"")
        + chunk(b"IDAT", zlib.compress(data or bytes(inflated)))
        + chunk(b"IEND", b"")
    )


def sparse(path: Path, head: bytes, size: int) -> Path:
    """A file of ``size`` bytes that takes no room on the disk."""
    with path.open("wb") as file:
        file.write(head)
        file.truncate(size)
    return path


def pipe(path: Path) -> Path:
    """A named pipe that nobody writes to."""
    os.mkfifo(path)
    return path


def limited(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """A command in a process with 4 GiB of data and `LIMIT_S`."""
    return python(
        "-m", "touchdown", *arguments, cwd=folder, timeout=LIMIT_S,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES)),
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
