"""A tracked robot on a forest path: where it has driven, the map of the sweep that it takes then must let it drive."""

from itertools import pairwise

import numpy as np
from right_maps import Box, Grid, Seen, built, seen
from right_recordings import Offroad
from right_row import Row, percent
from scipy.spatial import cKDTree

BOX: Box = (-11.0, -10.0, 13.0, 14.0)
"""Around the sweep, for the pictures as well."""

HALF_WIDTH = 0.3
"""Metres on either side of the base's way: the robot is 0.6 m wide."""


def driven(way: np.ndarray, cells: Grid) -> np.ndarray:
    """The cells whose centres lie within half the robot's width of the straight lines between its poses (M, 2)."""
    steps = [np.linspace(a, b, 50) for a, b in pairwise(way)]
    centres = np.stack([cells.x, cells.y], axis=-1)
    return cKDTree(np.concatenate(steps)).query(centres)[0] < HALF_WIDTH


def passable(of: Seen, where: np.ndarray) -> float:
    """Percent of the cells there of which the map says anything that it calls free."""
    return percent(of.free[where & (of.free | of.forbidden)])


def read(surface: str, offroad: Offroad, model: str) -> Seen:
    """The place as a map of the one sweep says it is."""
    with built(surface, [offroad.sweep], model) as made:
        return seen(made, surface, BOX)


def rows(offroad: Offroad, before: dict[str, Seen], after: dict[str, Seen]) -> list[Row]:
    """The figures of the path by error model.

    What the robot has driven over is passable, whatever grows there; where it drives later, it may have gone through
    what the sweep still shows as an obstacle (it climbs a bank with bushes), so that only informs. One sweep from half
    a metre above the ground does not reach every cell: what it leaves unknown stands beside.
    """
    made = []
    for model, ground in after.items():
        every = before[model]
        on = f"off-road, {model}"
        early, late = (driven(way, ground.grid) for way in (offroad.before, offroad.after))
        both = early | late
        lost, lost_before = (percent(~(of.free | of.forbidden)[early]) for of in (ground, every))
        made += [
            Row(on, "driven before the sweep: passable, of known", "%", passable(ground, early), 95.0, least=True,
                before=passable(every, early)),
            Row(on, "driven before or after: passable, of known", "%", passable(ground, both),
                before=passable(every, both)),
            Row(on, "driven before the sweep: not known", "%", lost, before=lost_before),
        ]  # fmt: skip
    return made
