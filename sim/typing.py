"""Array types; shapes, units and frames stand where they are used."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Grey = NDArray[np.uint8]
Image = NDArray[np.uint8]
Int32 = NDArray[np.int32]
Uint32 = NDArray[np.uint32]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
