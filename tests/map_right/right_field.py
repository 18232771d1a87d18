"""People on an open field with nothing behind them but sky: what a scanner sees through it can tell only by what does
not come back, and so only if it says where it looks."""

import math

import numpy as np
from right_cast import Axes, Post, Scanner, Shape, Slab, drive
from right_maps import Sweep, add, make_map, seen
from right_row import Row
from scipy.spatial.transform import Rotation

from roughmap import Limits, georeference

RADIUS, TALL = 0.25, 1.75
PEOPLE = 5
FIRST_S, STOOD_S, GONE_S = 1.0, 3.0, 2.0
"""Seconds before people come, that they stand, and after."""

RATE = 10.0
FIELD = (45.0, 45.0, 180.0, 180.0)
"""Degrees up, down, left and right: all that the scanner sees."""


def blocked(seed: int, rounds: int, model: str, surface: str, limits: Limits) -> tuple[float, float]:
    """Percent of the cells that returned something of a person which are forbidden: while it stands, and 2 s after.

    The robot stands and rocks a little; ``PEOPLE`` stand 2.5 to 8 m around it at the same time, ``rounds`` times."""
    cells = then = after = 0
    scanner = Scanner(sector=180.0, rock=0.3)
    for turn in range(rounds):
        rng = np.random.default_rng([seed, turn])
        bearings = 2.0 * math.pi * (np.arange(PEOPLE) + rng.uniform(0.0, 0.6, PEOPLE)) / PEOPLE
        off = rng.uniform(2.5, 8.0, PEOPLE)
        spots = np.column_stack([off * np.cos(bearings), off * np.sin(bearings)])
        people: list[Shape] = [Post(x, y, RADIUS, 0.0, TALL) for x, y in spots]
        times = np.arange(0.0, FIRST_S + STOOD_S + GONE_S - 1e-9, 1.0 / RATE)
        there = (times >= FIRST_S) & (times < FIRST_S + STOOD_S - 1e-9)
        worlds = [[Slab(), *(people if stand else [])] for stand in there]
        at = np.tile([0.0, 0.0, rng.uniform(0.5, 1.2)], (len(times), 1))
        axes = Axes(rng.uniform(0.0, 2.0 * math.pi), tuple(rng.uniform(-3.0, 3.0, 3).tolist()))
        sweeps = drive(worlds, at, Rotation.identity(), scanner, axes, rng, RATE, limits)
        box = (-12.0, -12.0, 12.0, 12.0)
        with make_map(surface, model) as made:
            for k, sweep in enumerate(sweeps):
                add(made, surface, sweep)
                if there[k] and not there[k + 1]:
                    while_there = seen(made, surface, box)
            now = seen(made, surface, box)
        was = (
            now.grid.hits(np.concatenate([of_people(s, axes, spots) for s, k in zip(sweeps, there, strict=True) if k]))
            > 0
        )
        cells += int(was.sum())
        then += int(while_there.forbidden[was].sum())
        after += int(now.forbidden[was].sum())
    return 100.0 * then / cells, 100.0 * after / cells


def of_people(sweep: Sweep, axes: Axes, spots: np.ndarray) -> np.ndarray:
    """The points of a sweep, in the map, that lie on a person, over the ground."""
    placed = georeference(sweep.scan, sweep.trajectory, sweep.noise)[0]
    placed = placed[np.isfinite(placed[:, 0])]
    x, y = axes.local(placed[:, 0], placed[:, 1])
    near = np.hypot(x[:, None] - spots[:, 0], y[:, None] - spots[:, 1]).min(axis=1) < RADIUS + 0.05
    return placed[near & (placed[:, 2] > axes.shift[2] + 0.1)]


def rows(seed: int, rounds: int, model: str) -> list[Row]:
    """With the field of view declared, and without: then what stood before the sky stays."""
    made = []
    before = blocked(seed, rounds, model, "all", Limits())[1]
    for fov, mark in ((None, None), (FIELD, 1.0)):
        then, after = blocked(seed, rounds, model, "ground", Limits(fov=fov))
        on = f"open field, {model}" + (", field of view declared" if fov else "")
        note = f"of {then:.0f} % while there; {rounds * PEOPLE} people"
        made.append(Row(on, "a person who stood: cells blocked 2 s later", "%", after, mark, before=before, note=note))
    return made
