"""Arrow without pandas."""

from __future__ import annotations

import sys
from importlib.abc import MetaPathFinder
from types import ModuleType
from typing import Any


class _NoPandas(MetaPathFinder):
    def find_spec(self, name: str, _path: Any, _target: Any = None) -> None:
        if name == "pandas":
            raise ModuleNotFoundError(name, name=name)


def load_arrow() -> ModuleType:
    """The module ``pyarrow``, which does not look for pandas.

    It would load pandas, where that is installed, with the first array that it makes: twice the
    time of loading Arrow itself, for what nothing here uses. Pandas that is loaded already is left
    alone, and ``to_pandas`` loads it when it is called.
    """
    import pyarrow as pa

    if "pandas" not in sys.modules:
        finder = _NoPandas()
        sys.meta_path.insert(0, finder)
        try:
            pa.array([])
        finally:
            sys.meta_path.remove(finder)
    return pa
