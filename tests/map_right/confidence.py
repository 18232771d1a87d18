"""How often the true height of a cell lies in the interval that is stated for it, by strata."""

from typing import NamedTuple

import numpy as np
from confidence_map import mapped
from confidence_running import State, patch, stated
from confidence_scene import FIRST, GROUNDS, POSES, SIDE, Scene, scene

from roughmap.points.footprint import ERROR_MODELS

LEVELS = (0.5, 0.8, 0.9, 0.95, 0.99)

POINT_CLASSES = ((1, 1), (2, 2), (3, 5), (6, 12), (13, 30), (31, 1000))
SCAN_CLASSES = ((1, 1), (2, 5), (6, 20))

FEWEST = 1000
"""Cells of a stratum: of fewer nothing is said."""


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
    """Return the rows of all strata, for about that many ``cells`` of each kind of ground and pose error.

    All cells of a tile have the errors of the same poses, so that shares are known as if from a tenth of the cells.
    """
    rows = []
    for ground in GROUNDS:
        for poses in POSES:
            truth = scene(seed, ground, poses, cells // SIDE**2)
            for model in ERROR_MODELS:
                rows += rows_of(truth, mapped(truth, model), (model, poses, ground))
    return rows


def rows_of(truth: Scene, state: State, names: tuple[str, str, str]) -> list[Row]:
    """Return the rows of one error model, pose error and kind of ground, which are ``names``."""
    inside = patch(state)
    places = state.tile[inside], state.j[inside] - FIRST, state.i[inside] % 64 - FIRST
    # Of all cells, since the whole tile has a say; those outside the patch have no truth.
    error = np.zeros(len(inside))
    error[inside] = np.abs(state.mean[inside] - truth.truth[places])
    ours, paper = (p[inside] for p in stated(state, error))
    count, scans = state.count[inside], truth.met[places]
    model, poses, ground = names
    rows = []
    for low, high in POINT_CLASSES:
        for few, many in SCAN_CLASSES:
            chosen = (count >= low) & (count <= high) & (scans >= few) & (scans <= many)
            if chosen.sum() < FEWEST:
                continue
            for level in LEVELS:
                covered = _share(ours[chosen], level), _share(paper[chosen], level)
                rows.append(
                    Row(model, _name(low, high), _name(few, many), poses, ground, level, *covered, int(chosen.sum()))
                )
    return rows


def _name(low: int, high: int) -> str:
    return str(low) if low == high else f"{low}+" if high >= 1000 else f"{low}-{high}"


def _share(stated: np.ndarray, level: float) -> float:
    """Return how often the error lies in the interval of a level: where it was as likely or likelier to be smaller."""
    known = stated[~np.isnan(stated)]
    return float(np.mean(known <= level)) if len(known) else float("nan")
