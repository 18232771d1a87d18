"""The layers of a map of the ground from their definitions, a cell at a time: slow, and independent of the kernels."""

import math
from collections.abc import Iterable
from functools import cache
from typing import Any

import numpy as np
from scipy import stats

from roughmap.cell import TILE_CELLS
from roughmap.tiles.state import TileState

Tiles = dict[tuple[int, int], TileState]

LIMITS = {"slope": 0.5, "step": 0.2, "roughness": 0.1, "confidence": 0.9, "clearance": 2.0}


Row = dict[str, Any]
"""A record by names."""


def half_even(value: float) -> int:
    """Round as if the quotient had no rounding error."""
    return round(round(value, 9))


class ByDefinition:
    """A level of the map that consists of ``tiles``; cells (i, j) are numbered over the whole level."""

    def __init__(self, tiles: Tiles, side: float, limits: dict[str, float] | None = None, tolerance: float = 0.05):
        self.limits = LIMITS | (limits or {})
        self.tolerance = tolerance
        self.side = side
        self.tiles = tiles
        self.footprint = min(half_even(max(0.3, 1.5 * side) / side), 6)
        self.window = min(half_even(max(0.5, 2.0 * side) / side), 10)
        self.band = max(0.15, 0.6 * side)
        remembered = (
            "cell", "supported", "height", "plane", "step", "objects", "traversability", "_find", "_mean", "_summary",
            "_prior",
        )  # fmt: skip
        for name in remembered:
            setattr(self, name, cache(getattr(self, name)))  # one memory for each level

    def _find(self, kind: int, i: int, j: int) -> Row | None:
        tile = self.tiles.get((i // TILE_CELLS, j // TILE_CELLS))
        if tile is None or tile[kind] is None:
            return None
        array = tile[kind]
        row = array[(j % TILE_CELLS) * TILE_CELLS + i % TILE_CELLS].tolist()
        return dict(zip(array.dtype.names, row, strict=True))

    def cell(self, i: int, j: int) -> Row | None:
        """The record of a cell, None if nothing ever hit it."""
        found = self._find(0, i, j)
        return None if found is None or found["count"] == 0 else found

    def points(self, i: int, j: int) -> float:
        """n, the expected number of points."""
        cell = self.cell(i, j)
        return 0.0 if cell is None else float(cell["weight"] ** 2 / cell["weight_sq"])

    def supported(self, i: int, j: int) -> bool:
        cell = self.cell(i, j)
        if cell is None:
            return False
        column = self._find(2, i, j)
        if column is not None and column["flags"] & 1:
            return True
        total = 0.0
        for y in (j - 1, j, j + 1):
            for x in (i - 1, i, i + 1):
                other = self.cell(x, y)
                if other is not None and abs(other["mean"] - cell["mean"]) <= self.band:
                    total += self.points(x, y)
        return total >= 1.5

    def _mean(self, i: int, j: int) -> float:
        """The mean of a supported cell, infinity elsewhere."""
        return float(self.cell(i, j)["mean"]) if self.supported(i, j) else math.inf

    def height(self, i: int, j: int) -> float:
        """The known ground, NaN elsewhere."""
        here, r = self._mean(i, j), self.window
        if here == math.inf:
            return math.nan
        lowest = min(self._mean(x, y) for x in range(i - r, i + r + 1) for y in range(j - r, j + r + 1))
        return math.nan if here - lowest > self.limits["clearance"] else here

    def plane(self, i: int, j: int) -> tuple[float, float, float] | None:
        """Gradients and roughness, None if there is no plane: a weighted fit by orthogonal decomposition."""
        here, r, a = self.height(i, j), self.footprint, self.side
        rows, within, freedom = [], 0.0, 0.0
        for dj in range(-r, r + 1):
            for di in range(-r, r + 1):
                z = self.height(i + di, j + dj) - here
                distance = a * math.hypot(di, dj)
                most = max(self.limits["step"], 2.0 * math.tan(self.limits["slope"]) * distance)
                if self.limits["slope"] >= math.pi / 2:
                    most = math.inf
                if di * di + dj * dj > r * r + r or math.isnan(z) or abs(z) > most:
                    continue
                cell = self.cell(i + di, j + dj)
                rows.append((min(float(cell["count"]), 8.0), di * a, dj * a, z))
                n = self.points(i + di, j + dj)
                if n > 1.0 + 1e-6:
                    within += float(cell["m2"]) * n / float(cell["weight"])
                    freedom += n - 1.0
        if len(rows) < 4:
            return None
        w, x, y, z = np.array(rows).T
        mean_x, mean_y = np.average(x, weights=w), np.average(y, weights=w)
        spread = np.cov(x, y, aweights=w, ddof=0)
        if np.linalg.det(spread) < 1e-3 * np.trace(spread) ** 2 + 1e-12 or np.trace(spread) < 0.3 * a * a:
            return None
        root = np.sqrt(w)
        design = np.column_stack([np.ones_like(x), x - mean_x, y - mean_y])
        _, gx, gy = fitted = np.linalg.lstsq(design * root[:, None], z * root, rcond=None)[0]
        residual = np.average((z - design @ fitted) ** 2, weights=w)
        scatter = within / freedom if freedom >= 1.0 else 0.0
        inside = max(0.0, scatter - (gx * gx + gy * gy) * a * a / 12.0)
        return float(gx), float(gy), math.sqrt(residual + inside)

    def step(self, i: int, j: int) -> float:
        here, r, a = self.height(i, j), self.footprint, self.side
        if math.isnan(here):
            return math.nan
        gx, gy = self._gradient(i, j)
        most = 0.0
        for dj in range(-r, r + 1):
            for di in range(-r, r + 1):
                distance = a * math.hypot(di, dj)
                there = self.height(i + di, j + dj)
                if (di or dj) and distance <= max(0.3, 1.5 * a) + 1e-9 and not math.isnan(there):
                    drop = here - there
                    if distance > 0.3:
                        drop -= abs(gx * di * a + gy * dj * a) * (distance - 0.3) / distance
                    most = max(most, drop)
        return most

    def _gradient(self, i: int, j: int) -> tuple[float, float]:
        plane = self.plane(i, j)
        return (0.0, 0.0) if plane is None else plane[:2]

    def bin(self, i: int, j: int, number: int) -> int:
        """Hits in a bin, whose number counts from height 0."""
        column = self._find(2, i, j)
        if column is None or not column["flags"] & 2:
            return 0
        k = number - 2 * int(column["base"])
        return (int(column["bins"][k // 2]) >> 4 * (k % 2)) & 15 if 0 <= k < 80 else 0

    def objects(self, i: int, j: int) -> tuple[float, float, float]:
        """Obstacle, obstacle_top, overhang_low."""
        here = self.height(i, j)
        if math.isnan(here):
            return math.nan, math.nan, math.nan
        column = self._find(2, i, j)
        found = []
        if column is not None and column["flags"] & 2:
            lowest = self.limits["step"] + 0.7 * math.hypot(*self._gradient(i, j)) * self.side
            for number in range(2 * int(column["base"]), 2 * int(column["base"]) + 80):
                over = (number + 0.5) * 0.05 - here
                near = (
                    self.bin(x, y, k)
                    for y in (j - 1, j, j + 1)
                    for x in (i - 1, i, i + 1)
                    for k in (number - 1, number, number + 1)
                )
                if self.bin(i, j, number) and over > lowest and sum(near) >= 3:
                    found.append(over)
        blocking = [over for over in found if over < self.limits["clearance"]]
        hanging = [over for over in found if over >= self.limits["clearance"]]
        return float(bool(blocking)), max(blocking, default=math.nan), min(hanging, default=math.nan)

    def traversability(self, i: int, j: int) -> float:
        if math.isnan(self.height(i, j)):
            return math.nan
        step, (obstacle, _, _) = self.step(i, j), self.objects(i, j)
        if obstacle or step >= self.limits["step"]:
            return 0.0
        plane = self.plane(i, j)
        if plane is None:
            return math.nan
        slope = math.atan(math.hypot(*plane[:2]))
        terms = [1.0 - value / self.limits[name] for name, value in (("slope", slope), ("step", step))]
        terms += [1.0 - plane[2] / self.limits["roughness"]]
        terms += [self.trust(i, j)["local_confidence"] / self.limits["confidence"]]
        return min(max(min(terms), 0.0), 1.0)

    def _summary(self, i: int, j: int) -> tuple[float, ...]:
        cell, trust = self.cell(i, j), self._find(1, i, j)
        n, count = self.points(i, j), float(cell["count"])
        ne = (n + count) / 2.0
        extra = float(trust["pose_variance"]) - float(trust["variance"])
        scatter = ne * float(cell["m2"]) / float(cell["weight"])
        common = float(trust["variance"]) + float(trust["mount_sigma"]) ** 2
        return n, count, ne, max(ne - 1.0, 0.0), ne * max(extra, 0.0), scatter, common

    def _prior(self, x: int, y: int) -> tuple[float, float]:
        """s0^2 and f0 of a tile."""
        estimates = []
        for j in range(TILE_CELLS):
            for i in range(TILE_CELLS):
                if self.cell(x * TILE_CELLS + i, y * TILE_CELLS + j) is not None:
                    *_, f, shared, scatter, _ = self._summary(x * TILE_CELLS + i, y * TILE_CELLS + j)
                    if f > 0.0 and _part(0.03**2, shared, f) * f >= 4.0:
                        estimates.append((scatter - shared) / f)
        if len(estimates) < 20:
            return 0.03**2, 2.0
        return max(sorted(estimates)[(len(estimates) - 1) // 2], 0.005**2), 4.0

    def trust(self, i: int, j: int) -> dict[str, float]:
        """The four layers of trust of a cell that was hit."""
        prior, f0 = self._prior(i // TILE_CELLS, j // TILE_CELLS)
        n, count, ne, f, shared, scatter, common = self._summary(i, j)
        b = _part(prior, shared, f) if f > 0.0 else 0.0
        s2 = max((f0 * prior + b * (scatter - shared)) / (f0 + b * f), prior / 10.0)
        own = s2 * (1.0 / ne + 0.05 * (1.0 - min(n / count, 1.0)))
        var = own + common
        free = f0 + b * f
        df = var**2 / (own**2 / free)
        d = self.tolerance
        return {
            "mean_sigma": math.sqrt(var),
            "interval_95": float(stats.t.isf(0.025, df)) * math.sqrt(var),
            "confidence": 1.0 - 2.0 * float(stats.t.sf(d / (2.0 * math.sqrt(var)), df)),
            "local_confidence": 1.0 - 2.0 * float(stats.t.sf(d / (2.0 * math.sqrt(own)), free)),
        }

    def layers(self, i: int, j: int) -> dict[str, float]:
        """All layers that are not of the record alone, and the mean height."""
        here = self.height(i, j)
        names = ("mean_sigma", "interval_95", "confidence", "local_confidence")
        trust = dict.fromkeys(names, math.nan) if math.isnan(here) else self.trust(i, j)
        plane = None if math.isnan(here) else self.plane(i, j)
        gx, gy, rough = (math.nan, math.nan, math.nan) if plane is None else plane
        obstacle, top, low = self.objects(i, j)
        traversability = self.traversability(i, j)
        share = math.nan if math.isnan(traversability) else float(traversability > 0.0)
        return trust | {
            "mean_height": here, "count": 0.0 if math.isnan(here) else float(self.cell(i, j)["count"]),
            "gradient_x": gx, "gradient_y": gy, "slope": math.atan(math.hypot(gx, gy)), "roughness": rough,
            "step_height": self.step(i, j), "obstacle": obstacle, "obstacle_top": top, "overhang_low": low,
            "traversability": traversability, "passable_share": share,
        }  # fmt: skip


def _part(prior: float, shared: float, f: float) -> float:
    return (prior / (prior + shared / f)) ** 2


class CoarseByDefinition(ByDefinition):
    """Level ``z`` >= 1 over a level 0, from all level-0 cells below each of its own."""

    def __init__(self, fine: ByDefinition, z: int) -> None:
        super().__init__({}, fine.side * 2**z, fine.limits, fine.tolerance)
        self.fine, self.z = fine, z
        self._trusted = cache(self._trusted)

    def below(self, i: int, j: int) -> Iterable[tuple[int, int]]:
        size = 2**self.z
        return ((x, y) for y in range(j * size, (j + 1) * size) for x in range(i * size, (i + 1) * size))

    def cell(self, i: int, j: int) -> Row | None:
        known = [cell for place in self.below(i, j) if (cell := self.fine.cell(*place)) is not None]
        if not known:
            return None
        w, mean = (np.array([cell[name] for cell in known]) for name in ("weight", "mean"))
        middle = np.average(mean, weights=w)
        sums = {name: float(sum(cell[name] for cell in known)) for name in ("count", "weight", "weight_sq", "m2")}
        return sums | {"mean": middle, "m2": sums["m2"] + float((w * (mean - middle) ** 2).sum())}

    def _trusted(self, i: int, j: int) -> dict[str, float]:
        known = [place for place in self.below(i, j) if self.fine.cell(*place) is not None]
        w = [float(self.fine.cell(*place)["weight"]) for place in known]
        trust = [self.fine._find(1, *place) for place in known]
        sigma = np.average([math.sqrt(one["variance"]) for one in trust], weights=w)
        pose, mount = (np.average([one[name] for one in trust], weights=w) for name in ("pose_variance", "mount_sigma"))
        return {"variance": sigma**2, "pose_variance": pose, "mount_sigma": mount}

    def _find(self, kind: int, i: int, j: int) -> Row | None:
        return self._trusted(i, j) if kind == 1 else None

    def supported(self, i: int, j: int) -> bool:
        return any(self.fine.supported(*place) for place in self.below(i, j))

    def objects(self, i: int, j: int) -> tuple[float, float, float]:
        every = [self.fine.objects(*place) for place in self.below(i, j)]
        return tuple(_known(how, values) for how, values in zip((max, max, min), zip(*every, strict=True), strict=True))

    def traversability(self, i: int, j: int) -> float:
        return _known(min, [self.fine.traversability(*place) for place in self.below(i, j)])

    def layers(self, i: int, j: int) -> dict[str, float]:
        rated = [value for place in self.below(i, j) if not math.isnan(value := self.fine.traversability(*place))]
        share = sum(value > 0.0 for value in rated) / len(rated) if rated else math.nan
        return super().layers(i, j) | {"passable_share": share}


def _known(how, values: Iterable[float]) -> float:
    return how((value for value in values if not math.isnan(value)), default=math.nan)
