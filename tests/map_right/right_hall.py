"""A hall's flat floor, seen 14 times from one place: where it is open, the map must say so, at the floor's height.

The truth is had from the points themselves. The floor is the plane through what lies near it, found by narrowing down,
and the floor's waves about that plane, as means over a square of ``WAVE``. A cell of the hall is

- open: a floor point in it, and nothing between the floor and the vehicle's height in it and its eight neighbours;
- an obstacle: at least three points, of two scans or more, that a vehicle of the usual limits would meet.
"""

from dataclasses import dataclass

import numpy as np
from right_maps import Box, Grid, Seen, Sweep, built, grid, seen
from right_recordings import Hall
from right_row import Row, percent
from scipy.ndimage import binary_dilation, uniform_filter

REACH = 20.0
"""Metres around the scanner, within which cells are judged: 12,000 cells of open floor."""

BOX: Box = (-REACH, -REACH, REACH, REACH)

NEAR_PLANE = 0.1
"""What lies farther than this from the floor is no floor: it stands on it or hangs over it."""

BODY = 0.15, 2.0
"""Metres above the floor between which anything keeps a cell from being open."""

MET = 0.25, 1.9
"""Metres above the floor between which a vehicle meets what is there: steps of 0.2 m and the height of 2 m, and 5 and
10 cm that noise and bins may take."""

WAVE = 1.1
WRONG = 0.05
"""Metres: a height of floor is wrong beyond that."""

AT_FLOOR = 0.15
"""Metres from the floor within which the map's height is that of the floor, not of what stands on it."""


@dataclass(frozen=True)
class Truth:
    """Of each cell of ``BOX``. ``floor``: height, metres, the plane's far from any floor point."""

    grid: Grid
    bare: np.ndarray
    """Nothing stands here, whether or not a floor point was seen."""
    open: np.ndarray
    obstacle: np.ndarray
    floor: np.ndarray


def plane(points: np.ndarray) -> np.ndarray:
    """z = c0 x + c1 y + c2 through what lies near it, by least squares, narrowing down from what lies around -1.6 m
    within 5 m, where only the floor is."""
    A = np.column_stack([points[:, :2], np.ones(len(points))])
    off = np.hypot(points[:, 0], points[:, 1])
    c = np.array([0.0, 0.0, -1.6])
    near = (np.abs(points[:, 2] - A @ c) < 0.5) & (off < 5.0)
    for gate in (0.3, 0.2, *[NEAR_PLANE] * 5):
        c = np.linalg.lstsq(A[near], points[near, 2], rcond=None)[0]
        near = (np.abs(points[:, 2] - A @ c) < gate) & (off < REACH)
    return c


def truth(hall: Hall) -> Truth:
    """Where the floor is open, where obstacles stand, and how high the floor is, from all recorded points."""
    cells = grid(BOX)
    scans = [hall.placed(k) for k in range(len(hall.points))]
    points = np.concatenate(scans)
    c = plane(points)

    def above(own: np.ndarray) -> np.ndarray:
        return own[:, 2] - own[:, :2] @ c[:2] - c[2]

    def number(own: np.ndarray, low: float, high: float) -> np.ndarray:
        up = above(own)
        return cells.hits(own[(up > low) & (up < high)])

    floor = np.abs(above(points)) < NEAR_PLANE
    many = number(points, -NEAR_PLANE, NEAR_PLANE)
    off = cells.sums(points[floor], above(points)[floor])
    size = round(WAVE / cells.cell)
    weight = uniform_filter(many.astype(float), size)
    wave = np.divide(uniform_filter(off, size), weight, out=np.zeros_like(off), where=weight > 1e-9)
    in_reach = np.hypot(cells.x, cells.y) < REACH
    occupied = binary_dilation(number(points, *BODY) > 0, np.ones((3, 3)))
    in_scans = sum((number(own, *MET) > 0).astype(int) for own in scans)
    obstacle = (number(points, *MET) >= 3) & (in_scans >= 2) & in_reach
    bare = ~occupied & in_reach
    return Truth(cells, bare, (many > 0) & bare, obstacle, c[0] * cells.x + c[1] * cells.y + c[2] + wave)


def forbidden(of: Seen, true: Truth) -> float:
    """Percent of the open floor that the map knows and forbids, of all open floor that it knows."""
    return percent(of.forbidden[true.open & of.known])


def wrong(of: Seen, true: Truth) -> float:
    """Percent of the known open floor whose height is off by more than ``WRONG``."""
    at = true.open & of.known
    return percent(np.abs(of.height - true.floor)[at] > WRONG)


def called_free(of: Seen, true: Truth) -> float:
    """Percent of the obstacles' cells that the map calls free, at about the floor's height: there a planner would drive
    into what stands. Where the map takes the obstacle's top for the ground (a table's), it is not counted here."""
    at_floor = np.abs(of.height - true.floor) < AT_FLOOR
    return percent((of.free & at_floor)[true.obstacle])


def unknown(of: Seen, true: Truth) -> float:
    """Percent of the open floor of which the map says neither free nor forbidden."""
    return percent(~(of.free | of.forbidden)[true.open])


def read(surface: str, sweeps: list[Sweep], model: str) -> Seen:
    """The hall as a map of these sweeps says it is."""
    with built(surface, sweeps, model) as made:
        return seen(made, surface, BOX)


def rows(hall: Hall, before: dict[str, Seen], after: dict[str, Seen], true: Truth) -> list[Row]:
    """The figures of the hall by error model; ``before`` with surface "all", ``after`` with "ground"."""
    made = []
    for model, ground in after.items():
        every = before[model]
        on = f"hall, {model}"
        made += [
            Row(on, "open floor forbidden", "%", forbidden(ground, true), 0.5, before=forbidden(every, true)),
            Row(on, "open floor off by > 5 cm", "%", wrong(ground, true), 0.5, before=wrong(every, true)),
            Row(on, "obstacles called free at floor height", "%", called_free(ground, true), 0.5,
                before=called_free(every, true)),
            Row(on, "open floor neither free nor forbidden", "%", unknown(ground, true), before=unknown(every, true)),
        ]  # fmt: skip
    return made
