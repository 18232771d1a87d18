"""The update of a cell's trust: how far errors that its points have in common reach its mean height."""

import numpy as np
from numba.np.numpy_support import carray

from roughmap.arrays import Scalar
from roughmap.intrinsics import pointer
from roughmap.jit import inline

TRUST_WORDS = 5
_V, _L, _C, _M, _MS = np.uint64(0), np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)


@inline
def alike_for(pose_error_time: Scalar) -> Scalar:
    """Return 4 tau in milliseconds: errors of poses that are farther apart have nothing in common."""
    return np.float32(4000.0 * pose_error_time)


@inline
def update_trust(address: Scalar, g: Scalar, common: Scalar, mount: Scalar, ms: Scalar, span: Scalar) -> None:
    """Update the trust at ``address`` (TRUST_DTYPE) after a point moved the mean height by the part ``g`` of its way.

    ``common``: variance of the point's height from its pose. ``mount``: its standard deviation from the mounting.
    ``ms``: its stamp in milliseconds, modulo 2^32. ``span``: see `alike_for`. All in float32, each step rounded: with
    r = 1 - g, d = the smaller difference of the stamps and y = max(0, 1 - d / span),
    L *= y^4; V = r (r V + 2 g L) + g^2 common; L = r L + g common; C += g (common - C); M += g (mount - M).
    """
    trust = carray(pointer(address, _ZERO), (TRUST_WORDS,))
    stamp = carray(pointer(address, np.uint32(0)), (TRUST_WORDS,))
    g = np.float32(g)
    r = _ONE - g
    V, L, C, M = trust[_V], trust[_L], trust[_C], trust[_M]
    if stamp[_MS] != ms:
        # 32 bits wrap: the smaller of both differences.
        ahead, behind = np.uint32(ms - stamp[_MS]), np.uint32(stamp[_MS] - ms)
        d = np.float32(np.int64(min(ahead, behind)))
        y = max(_ZERO, _ONE - d / span)
        square = y * y
        L = L * (square * square)
        stamp[_MS] = ms
    own = g * common
    V = r * (r * V + (_TWO * g) * L) + (g * g) * common
    trust[_V] = V
    trust[_L] = r * L + own
    trust[_C] = C + g * (common - C)
    trust[_M] = M + g * (mount - M)
