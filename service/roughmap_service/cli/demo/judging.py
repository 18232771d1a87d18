"""How well a map does against the true world: counts and errors over cells."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roughmap_service.simulation.truth import NEAR, Truth, Why

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Judgement:
    """Shares are 0 to 1; None is unknown: no cell to judge, or a layer that the map does not have.

    A map of cells can't say to the centimetre where an obstacle ends. So a blocked cell that the map calls free is only
    wrong if the map blocks none of the 8 around it, and a free cell that the map blocks only if all 8 are truly free.
    Where a part of the ground within a wheel's reach is unknown, the map need not know of a step: it is not judged.
    """

    cells: int
    known: int
    blocked: int
    """Known cells that are truly impassable, whose place is judged."""

    wrongly_free: float | None
    free: int
    """Known cells that are truly passable, and those around them."""

    wrongly_forbidden: float | None
    wrongly_forbidden_hard: float | None
    """The same without the cells of tall grass."""

    height_error_median_m: float | None
    height_error_p95_m: float | None
    covered: float | None
    """Share of the known heights whose 95 % interval holds the true one."""


def judge(
    truth: Truth,
    cell_size: float,
    traversability: npt.ArrayLike,
    height: npt.ArrayLike,
    interval: npt.ArrayLike | None = None,
) -> Judgement:
    """Compare layers, (ny, nx) with NaN where unknown, with the truth of the same cells.

    `interval` is the half width of the 95 % interval of the height.
    """
    score = np.asarray(traversability, dtype=np.float64)
    forbidden, judged = score == 0, np.isfinite(score)
    seen = ~_near(~judged, round(NEAR / cell_size))
    blocked = judged & ~truth.passable & (seen | (truth.why == Why.OBJECT))
    free = judged & ~_near(~truth.passable)
    hard = free & ~_near(truth.soft)
    error = np.abs(np.asarray(height, dtype=np.float64) - truth.height)
    measured = np.isfinite(error)
    half = None if interval is None else np.asarray(interval, dtype=np.float64)
    return Judgement(
        cells=score.size,
        known=int(np.isfinite(np.asarray(height, dtype=np.float64)).sum()),
        blocked=int(blocked.sum()),
        wrongly_free=_share(~_near(forbidden), blocked),
        free=int(free.sum()),
        wrongly_forbidden=_share(forbidden, free),
        wrongly_forbidden_hard=_share(forbidden, hard),
        height_error_median_m=_percentile(error[measured], 50),
        height_error_p95_m=_percentile(error[measured], 95),
        covered=None if half is None else _share(error <= half, measured & np.isfinite(half)),
    )


def _near(flags: Flags, cells: int = 1) -> Flags:
    """Return the cells in whose square, so many cells to each side, one is flagged."""
    rows, columns = flags.shape
    around = np.pad(flags, cells)
    near = np.zeros_like(flags)
    for j in range(2 * cells + 1):
        for i in range(2 * cells + 1):
            near |= around[j : j + rows, i : i + columns]
    return near


def _share(of: Flags, among: Flags) -> float | None:
    count = int(among.sum())
    return int((of & among).sum()) / count if count else None


def _percentile(values: Floats, q: float) -> float | None:
    return float(np.percentile(values, q)) if values.size else None
