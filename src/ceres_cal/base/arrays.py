"""Arrays by the kind of their numbers, once for the whole package. Shapes stand in the docstrings."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
"""Grey pictures at work, and maps of pixels."""
Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]
"""Row numbers, and where each of several runs of rows begins."""
Indices32 = NDArray[np.int32]
"""The same in columns with a row for each observation, as files and kernels have them."""
Codes = NDArray[np.int8]
"""One of a few cases: the side of a line, a reason."""
Image = NDArray[Any]
"""A photograph as read, of any depth."""
Image8 = NDArray[np.uint8]
AnyArray = NDArray[Any]
