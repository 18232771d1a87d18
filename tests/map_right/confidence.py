"""How often the true height of a cell lies in the interval that is stated for it, by strata."""

from typing import NamedTuple

import numpy as np
from confidence_running import patch, run, stated
from confidence_scene import FIRST, GROUNDS, POSES, SIDE, scene

LEVELS = (0.5, 0.8, 0.9, 0.95, 0.99)

POINT_CLASSES = ((1, 1), (2, 2), (3, 5), (6, 12), (13, 30), (31, 1000))
SCAN_CLASSES = ((1, 1), (2, 5), (6, 20))


class Row(NamedTuple):
    """One stratum at one level: the stated probability, and how often it held; NaN where the paper's says nothing."""

    stratum: str
    points: str
    scans: str
    pose_error: str
    ground: str
    stated: float
    covered: float
    paper: float
    cells: int


def coverage_table(seed: int, cells: int) -> list[Row]:
    """Return the rows of all strata, for about that many ``cells`` of each kind of ground and pose error."""
    rows = []
    for model in ("point", "cuboid"):
        for ground in GROUNDS:
            for poses in POSES:
                rows += rows_of(seed, model, ground, poses, cells // SIDE**2)
    return rows


def rows_of(seed: int, model: str, ground: str, poses: str, tiles: int) -> list[Row]:
    """Return the rows of one model, kind of ground and pose error."""
    truth = scene(seed, ground, poses, tiles)
    state = run(truth, model)
    inside = patch(state)
    places = state.tile[inside], state.j[inside] - FIRST, state.i[inside] - FIRST
    # Of all cells, since the whole tile has a say; those outside the patch have no truth.
    error = np.zeros(len(inside))
    error[inside] = np.abs(state.mean[inside] - truth.truth[places])
    ours, paper = (p[inside] for p in stated(state, error))
    count, scans = state.count[inside], state.scans[inside]
    rows = []
    for low, high in POINT_CLASSES:
        for few, many in SCAN_CLASSES:
            chosen = (count >= low) & (count <= high) & (scans >= few) & (scans <= many)
            names = (model, _name(low, high), _name(few, many), poses, ground)
            if chosen.sum() >= tiles // 4:
                rows += [
                    Row(*names, level, _share(ours[chosen], level), _share(paper[chosen], level), int(chosen.sum()))
                    for level in LEVELS
                ]
    return rows


def _name(low: int, high: int) -> str:
    return str(low) if low == high else f"{low}+" if high >= 1000 else f"{low}-{high}"


def _share(stated: np.ndarray, level: float) -> float:
    """Return how often the error lies in the interval of a level: where it was as likely or likelier to be smaller."""
    known = stated[~np.isnan(stated)]
    return float(np.mean(known <= level)) if len(known) else float("nan")
