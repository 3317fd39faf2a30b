"""A pilot at the keyboard of dm_control's viewer."""

from __future__ import annotations

from typing import Any

import glfw
import numpy as np
from numpy.typing import NDArray

_KEYS = (
    (glfw.KEY_UP, glfw.KEY_DOWN),
    (glfw.KEY_LEFT, glfw.KEY_RIGHT),
    (glfw.KEY_PAGE_UP, glfw.KEY_PAGE_DOWN),
    (glfw.KEY_HOME, glfw.KEY_END),
)
"""For forward, left, up, yaw to the left, and against them: keys that the viewer leaves free, but
for the right arrow, which steps a viewer that is paused."""


class Keyboard:
    """A policy of ``land_by_velocity`` for ``dm_control.viewer.launch``: arrows fly forward, back,
    left and right, Page Up and Page Down climb and sink, Home and End turn. Without a key the
    vehicle hovers. speed: share of the greatest velocities, above 0, at most 1."""

    def __init__(self, speed: float = 0.4) -> None:
        self._speed = speed

    def __call__(self, time_step: Any) -> NDArray[np.float32]:
        """Returns the action of the keys that are down, (4,) float32; zeros without a window."""
        window = glfw.get_current_context()  # after a frame, the viewer's window
        if not window:
            return np.zeros(4, np.float32)
        down = [[glfw.get_key(window, key) == glfw.PRESS for key in pair] for pair in _KEYS]
        return self._speed * np.array([float(a) - float(b) for a, b in down], np.float32)
