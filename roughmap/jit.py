"""The one way in which kernels are compiled."""

from collections.abc import Callable
from typing import TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., object])


def kernel(function: F) -> F:
    """Compile ``function`` with numba.

    Without the GIL, cached on disk, and with IEEE division: a Python zero-division check in a loop keeps it from
    being vectorised. ``fastmath`` stays off, so that the same source gives the same bits on every machine.
    """
    compiled = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    return cast("F", compiled)


def inline(function: F) -> F:
    """The same for small helpers that are always inlined into a kernel by LLVM."""
    compiled = numba.njit(cache=True, nogil=True, error_model="numpy", inline="never", forceinline=True)(function)
    return cast("F", compiled)
