"""Array types of images and counts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Int32 = NDArray[np.int32]
Counts = NDArray[np.int64]
