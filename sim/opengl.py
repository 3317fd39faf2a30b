"""The OpenGL backend that MuJoCo and dm_control read from ``MUJOCO_GL`` when they are imported."""

import ctypes
import os
import sys
import warnings

VARIABLE = "MUJOCO_GL"
_chosen = ""


def has_display() -> bool:
    """True if the environment names an X11 or Wayland display."""
    names = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
    return any(os.environ.get(name) for name in names)


def rendering_backend() -> str:
    """The first of EGL and OSMesa whose library loads here, else GLFW, which needs a display."""
    for backend, library in (("egl", "libEGL.so.1"), ("osmesa", "libOSMesa.so.8")):
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        return backend
    return "glfw"


def choose_backend() -> None:
    """Sets ``MUJOCO_GL`` where nobody has and there is no display, which GLFW, MuJoCo's default,
    would need. Where MuJoCo was imported before, one warning says what to set."""
    global _chosen
    if os.environ.get(VARIABLE) or has_display():
        return
    backend = os.environ.get("PYOPENGL_PLATFORM", "")  # MuJoCo refuses another one beside it
    if backend not in ("egl", "osmesa") and (backend := rendering_backend()) == "glfw":
        return
    if "mujoco" not in sys.modules:
        os.environ[VARIABLE] = _chosen = backend
        return
    drawn = getattr(sys.modules["mujoco"], "GLContext", None)
    if getattr(drawn, "__module__", "") == "mujoco.glfw":
        warnings.warn(
            "mujoco was imported before touchdown and draws with GLFW, which needs a display: set "
            f"{VARIABLE}={backend}, or import touchdown first",
            stacklevel=3,
        )


def asked_backend() -> str:
    """What the user has set ``MUJOCO_GL`` to, in lower case; "" for nothing."""
    asked = os.environ.get(VARIABLE, "").lower()
    return "" if asked == _chosen else asked
