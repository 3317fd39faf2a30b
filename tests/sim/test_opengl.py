"""The OpenGL backend that is chosen before MuJoCo is loaded."""

import os
import sys
import warnings
from types import ModuleType

import pytest

from touchdown.sim import opengl

from support.command import DISPLAY_VARIABLES, python, without_display


def chosen(**environment: str) -> str:
    """What ``import touchdown`` leaves in the variable."""
    code = "import touchdown, os; print(os.environ.get('MUJOCO_GL'))"
    return python("-c", code, env=without_display(**environment), check=True).stdout.strip()


def test_importing_chooses_a_backend_that_needs_no_display() -> None:
    found = opengl.rendering_backend()
    assert chosen() == ("None" if found == "glfw" else found)
    assert chosen(DISPLAY=":0") == "None" and chosen(MUJOCO_GL="glfw") == "glfw"
    assert chosen(PYOPENGL_PLATFORM="osmesa") == "osmesa"


def test_what_is_chosen_is_not_asked_for_and_mujoco_before_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in DISPLAY_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PYOPENGL_PLATFORM", "osmesa")
    monkeypatch.setattr(opengl, "_chosen", "")
    monkeypatch.delitem(sys.modules, "mujoco", raising=False)
    opengl.choose_backend()
    assert os.environ["MUJOCO_GL"] == "osmesa" and opengl.asked_backend() == ""
    monkeypatch.setenv("MUJOCO_GL", "EGL")
    assert opengl.asked_backend() == "egl"
    monkeypatch.delenv("MUJOCO_GL")
    before = ModuleType("mujoco")
    monkeypatch.setitem(sys.modules, "mujoco", before)
    for home in ("mujoco.egl", "mujoco.glfw"):
        before.GLContext = type("GLContext", (), {"__module__": home})  # type: ignore[attr-defined]
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            opengl.choose_backend()
        assert "MUJOCO_GL" not in os.environ
        assert [str(one.message).count("set MUJOCO_GL=osmesa") for one in said] == [1] * (
            home == "mujoco.glfw"
        )
