"""Threads and memory of the machine, and what it says where it cannot render."""

import contextlib
import ctypes
import functools
import gc
import importlib
import os
import re
import traceback
from collections.abc import Iterator
from typing import Any

from touchdown.experiments.external.processes import release_memory

BLAS_THREADS = "OPENBLAS_NUM_THREADS"
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_MMAP_MAX = -1, -3, -4
"""parameters of glibc's mallopt"""


def rendering_fault(error: Exception) -> str:
    """The reason and the remedy where ``error`` says that this machine cannot render; "" for other
    errors. MuJoCo looks for OpenGL when it is imported, and once more when a context is opened."""
    text = str(error)
    if text.startswith("no offscreen rendering"):
        return text
    names = [f.f_globals.get("__name__", "") for f, _ in traceback.walk_tb(error.__traceback__)]
    if not any(re.fullmatch(r"mujoco\..*gl_context", name) for name in names):
        return ""
    return (
        f"no offscreen rendering on this machine ({text}): set MUJOCO_GL to egl, osmesa or glfw, "
        "whichever is installed, or unset it"
    )


def limit_threads() -> None:
    """Keeps OpenCV, Numba and linear algebra on the calling thread, whatever the environment says:
    the sensors' worker needs the other core, and a flight must not depend on the number of threads
    that a library finds. Holds for the rest of the process; OpenMP and torch are left alone."""
    import cv2
    import numba
    import scipy.linalg  # noqa: F401  brings a copy of OpenBLAS, as OpenCV and NumPy do
    from threadpoolctl import threadpool_limits

    cv2.setNumThreads(1)
    # Its first choice, TBB, warns where an older one is installed; with one thread all are alike.
    layers: Any = numba.config
    layers.THREADING_LAYER_PRIORITY = sorted(layers.THREADING_LAYER_PRIORITY, key="tbb".__eq__)
    numba.set_num_threads(1)
    threadpool_limits(1, user_api="blas")
    os.environ[BLAS_THREADS] = "1"  # for copies that are loaded later, here or in a child


@functools.cache
def keep_bitcode() -> None:
    """Kernels that Numba loads from its cache keep what other kernels are compiled from, which
    their machine code does not need, as the bytes of the file: parsed it takes 0.4 MB a kernel.
    Holds for the rest of the process. Does nothing for a Numba whose inside is another."""
    codegen: Any = importlib.import_module("numba.core.codegen")
    kind: Any = getattr(codegen, "CPUCodeLibrary", None)
    if not all(hasattr(kind, name) for name in ("_unserialize", "_get_module_for_linking")):
        return
    loaded, linked = kind._unserialize.__func__, kind._get_module_for_linking

    def load(cls: Any, target: Any, state: Any) -> Any:
        library = loaded(cls, target, state)
        if state[1] == "object":
            library.bitcode, library._shared_module = state[2][1], None
        return library

    def link(library: Any) -> Any:
        if library._shared_module is None and hasattr(library, "bitcode"):
            library._shared_module = codegen.ll.parse_bitcode(library.bitcode)
        return linked(library)

    kind._unserialize = classmethod(load)
    kind._get_module_for_linking = link


@contextlib.contextmanager
def set_up_memory() -> Iterator[None]:
    """While a flight is set up, what is freed is used again: rasters of up to 100 MB come and go,
    and new pages of the system would take a third of the time. Afterwards free pages go back to it,
    and each block above 1 MB gets a mapping of its own, which goes back when it is freed: glibc
    would keep blocks of up to 32 MB, and holes between them stay."""
    set_malloc(max_mappings=0, trim_bytes=1 << 30)
    gc.freeze()  # what is there already need not be searched for what the set-up leaves
    try:
        yield
    finally:
        set_malloc(max_mappings=1 << 16, trim_bytes=1 << 17)
        release_memory()
        gc.unfreeze()


def set_malloc(max_mappings: int, trim_bytes: int) -> None:
    """Sets how many blocks above 1 MB get a mapping of their own at a time, and the free bytes at
    the end of the heap above which they go back to the system, -1 for never. Does nothing where the
    C library is not glibc."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # other C libraries lack it
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, 1 << 20)
        mallopt(_M_MMAP_MAX, max_mappings)
        mallopt(_M_TRIM_THRESHOLD, trim_bytes)
