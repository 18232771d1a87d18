"""The layers of a cell's own record, as many as are asked for in one pass over the records."""

from collections.abc import Iterable
from math import nan, sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from roughmap.arrays import F8, I8, U1, U8, Records
from roughmap.cell import CELL_DTYPE, TILE_CELLS
from roughmap.jit import inline, kernel
from roughmap.reading.functions import ROOT_HALF, erf
from roughmap.reading.layers import CELL_LAYERS, SINGLE_POINT

(
    MEAN_HEIGHT,
    MID_RANGE_HEIGHT,
    MAX_HEIGHT,
    MIN_HEIGHT,
    STD_DEV,
    RANGE,
    CONFIDENCE_LEVEL,
    CONFIDENCE_FACTOR,
    MEAN_VARIANCE,
    COUNT,
    WEIGHT,
    EXPECTED_COUNT,
    AGE,
) = range(len(CELL_LAYERS))

_NUMBERS = {name: number for number, name in enumerate(CELL_LAYERS)}

WEIGHT_AT, WEIGHT_SQ_AT, MEAN_AT, M2_AT, MIN_AT, MAX_AT, INV_CF_AT = range(1, 8)
"""Words of a record of ``CELL_DTYPE``. Word 0 is count | updated << 32."""

LOW_HALF = np.uint64(0xFFFFFFFF)

Values = npt.NDArray[Any]
"""float32 or float64."""


@inline
def _expected_count(weight: float, weight_sq: float) -> float:
    """Return n = W^2 / W2."""
    return weight * weight / weight_sq


@inline
def _std_dev(count: int, weight: float, weight_sq: float, m2: float) -> float:
    """Return eq. 6 for weights, sqrt(m2 / (W - W2/W)): NaN where the expected number of points is at most one."""
    if count >= 2 and _expected_count(weight, weight_sq) > SINGLE_POINT:
        return sqrt(m2 / (weight - weight_sq / weight))
    return nan


@kernel
def _fill(
    heads: U8, words: F8, numbers: I8, tolerance: float, newest: float, out: Values, step: int, layer_step: int
) -> None:
    """Fill the flat ``out`` with the layers ``numbers`` (L,) of N records.

    ``step``: from one cell's value to the next one's. ``layer_step``: from one layer's to the next one's. A row of
    cells at a time, layer by layer: so each loop has one formula, and the row's records stay in the cache.
    """
    for first in range(0, len(heads), TILE_CELLS):
        cells = range(first, min(first + TILE_CELLS, len(heads)))
        for k in range(len(numbers)):
            layer, at = numbers[k], k * layer_step
            if layer == MEAN_HEIGHT:
                for c in cells:
                    out[at + c * step] = words[c, MEAN_AT] if heads[c, 0] & LOW_HALF else nan
            elif layer == MID_RANGE_HEIGHT:
                for c in cells:
                    out[at + c * step] = 0.5 * (words[c, MAX_AT] + words[c, MIN_AT]) if heads[c, 0] & LOW_HALF else nan
            elif layer == MAX_HEIGHT:
                for c in cells:
                    out[at + c * step] = words[c, MAX_AT] if heads[c, 0] & LOW_HALF else nan
            elif layer == MIN_HEIGHT:
                for c in cells:
                    out[at + c * step] = words[c, MIN_AT] if heads[c, 0] & LOW_HALF else nan
            elif layer == STD_DEV:
                for c in cells:
                    count = heads[c, 0] & LOW_HALF
                    out[at + c * step] = _std_dev(count, words[c, WEIGHT_AT], words[c, WEIGHT_SQ_AT], words[c, M2_AT])
            elif layer == RANGE:
                for c in cells:
                    out[at + c * step] = words[c, MAX_AT] - words[c, MIN_AT] if heads[c, 0] & LOW_HALF else nan
            elif layer == CONFIDENCE_LEVEL:  # eq. 11: 2F(x) - 1 = erf(x / sqrt 2) with x = d sqrt(n) / (2 std_dev)
                for c in cells:
                    count, weight, weight_sq = heads[c, 0] & LOW_HALF, words[c, WEIGHT_AT], words[c, WEIGHT_SQ_AT]
                    spread = _std_dev(count, weight, weight_sq, words[c, M2_AT])
                    if spread == spread:  # noqa: PLR0124 - not NaN; erf(inf) = 1 where it is 0
                        x = tolerance * sqrt(_expected_count(weight, weight_sq)) / (2.0 * spread)
                        out[at + c * step] = erf(x * ROOT_HALF)
                    else:
                        out[at + c * step] = nan
            elif layer == CONFIDENCE_FACTOR:  # eq. 15, 16: 1 / inv_cf
                for c in cells:
                    out[at + c * step] = 1.0 / words[c, INV_CF_AT] if heads[c, 0] & LOW_HALF else nan
            elif layer == MEAN_VARIANCE:
                for c in cells:
                    count, weight, weight_sq = heads[c, 0] & LOW_HALF, words[c, WEIGHT_AT], words[c, WEIGHT_SQ_AT]
                    spread = _std_dev(count, weight, weight_sq, words[c, M2_AT])
                    out[at + c * step] = spread * spread / _expected_count(weight, weight_sq)
            elif layer == COUNT:
                for c in cells:
                    out[at + c * step] = float(heads[c, 0] & LOW_HALF)
            elif layer == WEIGHT:
                for c in cells:
                    out[at + c * step] = words[c, WEIGHT_AT]
            elif layer == EXPECTED_COUNT:
                for c in cells:
                    known = heads[c, 0] & LOW_HALF
                    out[at + c * step] = _expected_count(words[c, WEIGHT_AT], words[c, WEIGHT_SQ_AT]) if known else nan
            else:  # AGE: seconds from the cell's `updated` to the newest of the map
                for c in cells:
                    out[at + c * step] = newest - float(heads[c, 0] >> np.uint64(32)) if heads[c, 0] & LOW_HALF else nan


@kernel
def _known(heads: U8, bits: U1) -> int:
    """Fill ``bits`` (N / 8,) with one bit a record, as `numpy.packbits` packs them; return how many are known."""
    number = 0
    for place in range(len(bits)):
        byte = 0
        for cell in range(8 * place, 8 * place + 8):
            known = (heads[cell, 0] & LOW_HALF) != 0
            byte = 2 * byte + known
            number += known
        bits[place] = byte
    return number


def cell_layers(records: Records, names: Iterable[str], height_tolerance: float, newest_updated: int) -> dict[str, F8]:
    """Return the layers ``names``, all of ``CELL_LAYERS``, in this order, as float64 in the shape of ``records``.

    ``records``: of ``CELL_DTYPE``, of any level. Units are metres and seconds; unknown values are NaN.
    ``height_tolerance``: full width d of the interval of ``confidence_level`` (eq. 11). ``newest_updated``: newest
    `updated` of the map, from which ``age`` is counted. KeyError for a name that is not in ``CELL_LAYERS``.
    """
    chosen = tuple(names)
    numbers = _numbers(chosen)
    planes = np.empty((len(numbers), records.size))
    _fill(*as_words(records), numbers, height_tolerance, float(newest_updated), planes.reshape(-1), 1, records.size)
    return dict(zip(chosen, planes.reshape(-1, *records.shape), strict=True))


def packed_cell_layers(
    records: Records, names: Iterable[str], height_tolerance: float, newest_updated: int
) -> npt.NDArray[np.float32]:
    """Return the same values as float32, all layers of a cell together: the shape of ``records`` and an axis of layers.

    Values that float32 can't hold are infinite.
    """
    numbers = _numbers(names)
    packed = np.empty((*records.shape, len(numbers)), np.float32)
    _fill(*as_words(records), numbers, height_tolerance, float(newest_updated), packed.reshape(-1), len(numbers), 1)
    return packed


def known_bits(records: Records) -> tuple[int, bytes]:
    """Return how many of a tile's records are known, and which: a bit each, as `numpy.packbits` packs them."""
    bits = np.empty(records.size // 8, np.uint8)
    return _known(as_words(records)[0], bits), bits.tobytes()


def _numbers(names: Iterable[str]) -> I8:
    return np.array([_NUMBERS[name] for name in names], np.int64)


def as_words(records: Records) -> tuple[U8, F8]:
    """Return (N, 8) views of N records: their unsigned words and their floats."""
    flat = np.ascontiguousarray(records).reshape(-1)
    flat.flags.writeable = False  # numba compiles a kernel once more for arrays that may be written
    size = CELL_DTYPE.itemsize // 8
    return flat.view(np.uint64).reshape(-1, size), flat.view(np.float64).reshape(-1, size)
