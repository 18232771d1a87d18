"""Short names for array types."""

from typing import Any

import numpy as np
import numpy.typing as npt

F4 = npt.NDArray[np.float32]
F8 = npt.NDArray[np.float64]
I4 = npt.NDArray[np.int32]
I8 = npt.NDArray[np.int64]
U1 = npt.NDArray[np.uint8]
U2 = npt.NDArray[np.uint16]
U8 = npt.NDArray[np.uint64]
Flags = npt.NDArray[np.bool_]
Records = npt.NDArray[np.void]
"""Arrays of CELL_DTYPE, TRUST_DTYPE or COLUMN_DTYPE."""

Scalar = Any
"""A number, tuple or array inside a kernel; numba infers its type."""
