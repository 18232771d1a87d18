"""LZF, the compression of PCD files: pieces of text as they are, and copies of what came before.

A byte c below 32 is followed by c + 1 bytes as they are. Any other begins a copy: its upper three bits are the length
less 2, where 7 means that the next byte is to be added; its lower five bits and the next byte are the distance back,
less 1. A copy may overlap what it makes.
"""

import numpy as np
import numpy.typing as npt

from roughmap.jit import kernel

MOST_PER_BYTE = 88
"""No byte unpacks to more: three bytes give at most 264."""


def unpack(packed: bytes, size: int) -> npt.NDArray[np.uint8] | None:
    """Return the `size` bytes that `packed` stands for; None if it doesn't unpack to exactly so many."""
    if size > MOST_PER_BYTE * len(packed):
        return None
    out = np.empty(size, np.uint8)
    return out if _unpack(np.frombuffer(packed, np.uint8), out) else None


@kernel
def _unpack(packed: npt.NDArray[np.uint8], out: npt.NDArray[np.uint8]) -> bool:
    """Fill `out`; return whether `packed` has exactly what it needs."""
    i, o = 0, 0
    while i < len(packed):
        control = int(packed[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > len(packed) or o + length > len(out):
                return False
            for _ in range(length):
                out[o] = packed[i]
                i += 1
                o += 1
            continue
        length = control >> 5
        if length == 7:
            if i >= len(packed):
                return False
            length += int(packed[i])
            i += 1
        if i >= len(packed):
            return False
        begin = o - ((control & 31) << 8) - int(packed[i]) - 1
        i += 1
        length += 2
        if begin < 0 or o + length > len(out):
            return False
        for k in range(length):
            out[o + k] = out[begin + k]
        o += length
    return o == len(out)
