"""One cell of a ground map, point by point, in plain Python: its ground, the trust in it, and its column.

It shares no arithmetic with the kernels. Floats are Python's (float64) but for the trust, of which every step is
rounded to float32. One operation a step, in the kernels' order, so that the bytes can be compared.
"""

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from roughmap.cell import BASED, CELL_DTYPE, COLUMN_BINS, COLUMN_DTYPE, SUPPORTED, TRUST_DTYPE

CONFIRMED = 3
"""K: so many points make a ground sure, and so many points elsewhere make another ground."""

LIFETIME = 30
"""Seconds without a point off the ground after which single hits and a candidate are dropped."""

MOST_HITS = 15
"""A nibble holds no more."""

DEEP = 2.0
"""Metres below the ground. Points farther down need no more hits than points above."""

_F0, _F1, _F2 = np.float32(0.0), np.float32(1.0), np.float32(2.0)


class Hit(NamedTuple):
    """A point in one cell.

    ``h``: height. ``w``: its weight there, and ``q`` = w / share. ``stamp_ns``; ``common``, ``mount``: variances of the
    height from pose and mounting, m^2. ``up``: its beam rises too steeply to end on the ground. ``main``: this is the
    cell of the point's largest share.
    """

    h: float
    w: float
    q: float
    stamp_ns: int
    common: float
    mount: float
    up: bool
    main: bool


class CellRules(NamedTuple):
    """What a cell needs to know: side ``a`` and ``min_distance`` in metres, ``pose_error_time`` in seconds."""

    a: float
    min_distance: float
    pose_error_time: float

    @property
    def band(self) -> float:
        """How far above or below the mean a point may lie to be of the same ground."""
        return max(0.15, 0.6 * self.a)


@dataclass
class GroundCell:
    """Its ground (``count`` to ``inv_cf``), the trust in it (to ``stamp_ms``), and its column."""

    count: int = 0
    updated: int = 0
    weight: float = 0.0
    weight_sq: float = 0.0
    mean: float = 0.0
    m2: float = 0.0
    low: float = 0.0
    high: float = 0.0
    inv_cf: float = 0.0
    variance: np.float32 = _F0
    shared: np.float32 = _F0
    pose_variance: np.float32 = _F0
    mount_sigma: np.float32 = _F0
    stamp_ms: int = 0
    candidates: int = 0
    flags: int = 0
    candidate_mean: float = 0.0
    above_updated: int = 0
    base: int = 0
    bins: list[int] = field(default_factory=lambda: [0] * COLUMN_BINS)

    def records(self) -> tuple[Any, Any, Any]:
        """Return cell, trust and column as records, (1,) each, of the types that tiles hold."""
        cell = (self.count, self.updated, self.weight, self.weight_sq, self.mean, self.m2, self.low, self.high)
        column = (self.candidates, self.flags, 0, self.candidate_mean, self.above_updated, self.base)
        packed = np.array([even + 16 * odd for even, odd in zip(self.bins[::2], self.bins[1::2], strict=True)], "u1")
        return (
            np.array([(*cell, self.inv_cf)], CELL_DTYPE),
            np.array([(self.variance, self.shared, self.pose_variance, self.mount_sigma, self.stamp_ms)], TRUST_DTYPE),
            np.array([(*column, packed)], COLUMN_DTYPE),
        )

    def add(self, hit: Hit, rules: CellRules) -> None:
        """Take a point into the ground, or into the column, or begin another ground with it."""
        if self.count == 0:
            if not hit.up:
                self._take(hit, rules)
        elif not hit.up and abs(hit.h - self.mean) <= rules.band:
            self._take(hit, rules)
        elif hit.main and self._is_ground(hit, rules.band):
            self._begin_again(hit, rules)

    def _take(self, hit: Hit, rules: CellRules) -> None:
        """Update the ground (eq. 5, 13, 14, 16) and the trust in it."""
        before = self.weight
        self.weight = before + hit.w
        g = hit.w / self.weight
        if self.count == 0:
            self.mean = self.low = self.high = hit.h
        else:
            delta = hit.h - self.mean
            self.mean += delta * g
            self.m2 += (before * g) * (delta * delta)
            self.low, self.high = min(self.low, hit.h), max(self.high, hit.h)
        d = max(abs(hit.h - self.mean), rules.min_distance)
        self.inv_cf += hit.w / (d * d)
        self.weight_sq += hit.w * hit.q
        self.count = min(self.count + 1, 2**32 - 1)
        self.updated = max(self.updated, hit.stamp_ns // 1_000_000_000)
        self._trust(hit, np.float32(g), rules.pose_error_time)

    def _trust(self, hit: Hit, g: np.float32, pose_error_time: float) -> None:
        """Update the variances of the mean that its points have in common; their covariance fades with time."""
        r = _F1 - g
        c = np.float32(max(hit.common, 0.0))
        sigma = np.float32(math.sqrt(max(hit.mount, 0.0)))
        ms = hit.stamp_ns // 1_000_000 % 2**32
        apart = min((ms - self.stamp_ms) % 2**32, (self.stamp_ms - ms) % 2**32)
        y = max(_F0, _F1 - np.float32(apart) / np.float32(4000.0 * pose_error_time))
        square = y * y
        self.shared = self.shared * (square * square)
        self.stamp_ms = ms
        self.variance = r * (r * self.variance + (_F2 * g) * self.shared) + (g * g) * c
        self.shared = r * self.shared + g * c
        self.pose_variance = self.pose_variance + g * (c - self.pose_variance)
        self.mount_sigma = self.mount_sigma + g * (sigma - self.mount_sigma)

    def _is_ground(self, hit: Hit, band: float) -> bool:
        """Count a point off the ground in the column; return whether the ground is where this point is."""
        second = hit.stamp_ns // 1_000_000_000
        if not self.flags & BASED:
            self.flags |= BASED
            self.base = math.floor(10.0 * self.mean) - 11
            self.above_updated = second
        if second > self.above_updated + LIFETIME:
            self.bins = [0 if hits == 1 else hits for hits in self.bins]
            self.candidates = 0
        self.above_updated = max(self.above_updated, second)
        k = math.floor(20.0 * hit.h) - 2 * self.base
        supported = bool(self.flags & SUPPORTED) or self.count >= CONFIRMED
        if k >= COLUMN_BINS and (supported or hit.up):
            return False
        inside = 0 <= k < COLUMN_BINS
        if inside:
            self._hit(k, 1)
        if hit.up or (hit.h > self.mean and supported):
            return False
        if inside:
            return sum(self.bins[max(k - 1, 0) : k + 2]) >= self._need(hit.h)
        self._candidate(hit.h, band)
        return self.candidates >= CONFIRMED

    def _need(self, h: float) -> int:
        """Return how many hits around a height make it the ground."""
        if h > self.mean or self.mean - h > DEEP:
            return CONFIRMED
        return max(CONFIRMED, min(12, self.count // 5))

    def _candidate(self, h: float, band: float) -> None:
        """Count a point outside the bins for or against the ground that may be there."""
        if self.candidates == 0:
            self.candidates, self.candidate_mean = 1, h
        elif abs(h - self.candidate_mean) <= band:
            self.candidates += 1
            self.candidate_mean += (h - self.candidate_mean) / self.candidates
        elif self.candidates > 1:
            self.candidates -= 1
        else:
            self.candidates, self.candidate_mean = 1, h

    def _hit(self, k: int, hits: int) -> None:
        """Add hits to a nibble, if there is one for height ``k``."""
        if 0 <= k < COLUMN_BINS:
            self.bins[k] = min(self.bins[k] + hits, MOST_HITS)

    def _begin_again(self, hit: Hit, rules: CellRules) -> None:
        """Begin another ground with a point. The old one becomes hits in the column, too few to win if it is below."""
        mean, count = self.mean, self.count
        fresh = GroundCell()
        fresh._take(hit, rules)
        fresh.flags = BASED | SUPPORTED
        fresh.candidate_mean = self.candidate_mean
        fresh.above_updated = self.above_updated
        fresh.base = math.floor(10.0 * hit.h) - 11
        up = 2 * (fresh.base - self.base)
        fresh.bins = [self.bins[k + up] if 0 <= k + up < COLUMN_BINS else 0 for k in range(COLUMN_BINS)]
        most = MOST_HITS if mean > hit.h else CONFIRMED - 1
        fresh._hit(math.floor(20.0 * mean) - 2 * fresh.base, min(count, most))
        self.__dict__.update(fresh.__dict__)
