"""Open3D as flights load it."""

from __future__ import annotations

import subprocess
import sys

_PROGRAM = """
import sys
from touchdown.sim.geometry.open3d_core import load_open3d
open3d = load_open3d()
assert open3d.t.geometry.RaycastingScene(nthreads=1) is not None
assert not {"dash", "IPython", "plotly"} & set(sys.modules), "a viewer"
assert callable(open3d.visualization.draw_geometries) and "plotly" in sys.modules
assert not hasattr(open3d, "no_such_name")
assert load_open3d() is open3d
"""


def test_viewers_are_imported_when_somebody_asks_for_one() -> None:
    done = subprocess.run([sys.executable, "-c", _PROGRAM], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
