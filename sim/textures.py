"""Memory of a model's textures, once they are with the renderer."""

from __future__ import annotations

import ctypes
import mmap
from typing import Any


def give_back_textures(model: Any) -> None:
    """Returns the memory of an MjModel's textures to the system, 100 MB, where the system knows
    how: levels are undefined then, and whoever draws the model anew sees wrong colours."""
    advise = getattr(ctypes.CDLL(None), "madvise", None)
    if advise is None or not hasattr(mmap, "MADV_DONTNEED"):
        return
    levels = model.tex_data
    first = -(-levels.ctypes.data // mmap.PAGESIZE) * mmap.PAGESIZE
    size = (levels.ctypes.data + levels.nbytes - first) // mmap.PAGESIZE * mmap.PAGESIZE
    if size > 0:
        advise(ctypes.c_void_p(first), ctypes.c_size_t(size), mmap.MADV_DONTNEED)
