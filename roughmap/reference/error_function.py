"""The error function over arrays, for the normal distribution in eq. 11."""

import math

import numpy as np

from roughmap.arrays import F8
from roughmap.jit import kernel


@kernel
def _erf(values: F8, out: F8) -> None:
    for n in range(len(values)):
        out[n] = math.erf(values[n])


def erf(values: F8) -> F8:
    """Return erf of each value, in the same shape; NaN for NaN.

    It calls the C library, which is allowed here because no cell's bytes depend on it.
    """
    out = np.empty(values.shape)
    _erf(np.ascontiguousarray(values, dtype=np.float64).reshape(-1), out.reshape(-1))
    return out
