"""OpenGL contexts without a window: choice of a backend, and contexts that wait for their next use.

A new context of a renderer in software compiles its shaders anew, which takes 0.2 s.
"""

import atexit
import contextlib
import importlib
import os
import sys
import threading
import traceback
import warnings
from collections.abc import Iterator
from typing import Any

from touchdown.sim.opengl import asked_backend

BACKENDS = ("egl", "osmesa", "glfw")
"""In the order in which they are tried; GLFW needs a display."""
_MAX_IDLE = 2
_EGL = "mujoco.egl"

_idle: list[Any] = []
"""Contexts of EGL, which have no size, current in no thread"""
_lock = threading.Lock()


def gl_context(width: int, height: int) -> Any:
    """The first GL context that works, current in this thread: the one MUJOCO_GL names, else EGL,
    OSMesa, GLFW. Give it to `put_back` after use.

    MuJoCo's library reads MUJOCO_GL when it loads its GL functions, so it is set for the choice.
    RuntimeError, with what each backend said, when none works.
    """
    asked = asked_backend()
    if asked in ("", "egl") and (context := _waiting()) is not None:
        context.make_current()
        return context
    failures = []
    with _without_words():
        for backend in (asked,) if asked else BACKENDS:
            os.environ["MUJOCO_GL"] = backend
            try:
                return _open(backend, width, height)
            except Exception as failure:  # every backend fails in its own way
                failures.append(f"{backend}: {failure}")
                traceback.clear_frames(failure.__traceback__)  # drops a context that is half made
                if not asked:
                    _forget_opengl()
    if not asked:
        del os.environ["MUJOCO_GL"]
    raise RuntimeError(
        f"no offscreen rendering on this machine ({'; '.join(failures)}): install EGL "
        "(Debian: libegl1 libgl1-mesa-dri) or OSMesa (libosmesa6), or set MUJOCO_GL to egl, osmesa "
        "or glfw"
    )


def renderer_name() -> str:
    """What draws in the context that is current in this thread, in the driver's words (OpenGL's
    ``GL_RENDERER``)."""
    from OpenGL import GL

    name: bytes = GL.glGetString(GL.GL_RENDERER)
    return name.decode(errors="replace")


def put_back(context: Any) -> None:
    """Keeps or frees a context in the thread where it is current. What its user has made in it must
    be deleted."""
    with _lock:
        kept = type(context).__module__ == _EGL and len(_idle) < _MAX_IDLE
    if not kept:
        context.free()
        return
    egl = sys.modules[_EGL]
    nothing = egl.EGL.EGL_NO_SURFACE, egl.EGL.EGL_NO_SURFACE, egl.EGL.EGL_NO_CONTEXT
    egl.EGL.eglMakeCurrent(egl.EGL_DISPLAY, *nothing)
    with _lock:
        _idle.append(context)


def _waiting() -> Any:
    with _lock:
        return _idle.pop() if _idle else None


def _free_all() -> None:
    while (context := _waiting()) is not None:
        context.free()


@contextlib.contextmanager
def _without_words() -> Iterator[None]:
    """Drops what a backend that fails prints, also of its context that is half made. GLFW fails
    with no more than a warning: it is raised."""
    hook = sys.unraisablehook
    sys.unraisablehook = lambda _fault: None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.filterwarnings("error", message=r"\(\d+\) b'")
            yield
    finally:
        sys.unraisablehook = hook


def _open(backend: str, width: int, height: int) -> Any:
    context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
    context.make_current()
    if backend == "glfw" and not importlib.import_module("glfw").get_current_context():
        raise RuntimeError("it opens no window, not even a hidden one: is there a display?")
    # MuJoCo ends EGL at the exit of the program: contexts end before.
    atexit.unregister(_free_all)
    atexit.register(_free_all)
    return context


def _forget_opengl() -> None:
    """PyOpenGL ties itself to one platform at import; the next backend needs it afresh."""
    os.environ.pop("PYOPENGL_PLATFORM", None)
    tied = ("OpenGL", *(f"mujoco.{backend}" for backend in BACKENDS))
    for name in [n for n in sys.modules if n.startswith(tied)]:
        del sys.modules[name]
