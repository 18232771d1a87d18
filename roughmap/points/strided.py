"""Points read in place from a message, by address: one kernel serves every type, stride and alignment."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from roughmap.arrays import F8, Scalar
from roughmap.jit import inline
from roughmap.points.place import X, Y, Z


class Source(NamedTuple):
    """Memory of points (N, 3): address, bytes between rows and between columns, float64 or float32."""

    address: np.uint64
    row: np.int64
    column: np.int64
    double: bool


def source_of(points: npt.NDArray[np.floating]) -> Source:
    """Describe the memory of native float32 or float64 points; valid while ``points`` is alive."""
    row, column = points.strides
    return Source(
        np.uint64(points.__array_interface__["data"][0]), np.int64(row), np.int64(column), points.dtype == np.float64
    )


def _loader(number: types.Float, width: ir.Type) -> Any:
    def load(typingctx: Any, address: Any) -> Any:  # noqa: ARG001 - numba's calling convention
        def codegen(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> Any:  # noqa: ARG001
            return builder.load(builder.inttoptr(args[0], width.as_pointer()), align=1)

        return number(types.uint64), codegen

    return intrinsic(load)


_float32 = _loader(types.float32, ir.FloatType())
_float64 = _loader(types.float64, ir.DoubleType())


@inline
def read_points(source: Scalar, first: Scalar, size: Scalar, planes: F8) -> None:
    """Read ``size`` points, starting at number ``first``, into the rows X, Y, Z of a block's planes."""
    row, column = np.uint64(source.row), np.uint64(source.column)
    at = source.address + np.uint64(first) * row
    if source.double:
        for n in range(size):
            here = at + np.uint64(n) * row
            planes[X, n] = _float64(here)
            planes[Y, n] = _float64(here + column)
            planes[Z, n] = _float64(here + column + column)
    else:
        for n in range(size):
            here = at + np.uint64(n) * row
            planes[X, n] = _float32(here)
            planes[Y, n] = _float32(here + column)
            planes[Z, n] = _float32(here + column + column)
