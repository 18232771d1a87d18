"""People put into the recorded hall: they stand or walk on its open floor, and leave. What they were must go with them.

A person is an upright cylinder. Of a recorded scan, the beams that meet it return from it instead of from where they
did; so it hides what is behind it, and the hall around it is the recorded one.
"""

import math
from dataclasses import dataclass

import numpy as np
from right_cast import Post
from right_hall import BOX, Truth
from right_maps import add, make_map, seen
from right_recordings import Hall
from right_row import Row

from roughmap import Limits

RADIUS, TALL = 0.25, 1.75
"""Metres."""

NOISE = 0.01
"""Standard deviation of the person's ranges, metres: clothes."""

THERE = 7
"""Scans that see the people: 3.5 s."""

GONE = 4
"""Scans that don't, until the map is judged: 2 s."""

NEAR, FAR = 2.5, 8.0
"""Metres from the scanner: where people are put. Farther than a / 0.0105 = 9.5 m no scanner of this resolution
decides whether a cell is empty, and ghosts stay."""

PEOPLE = 5
"""At a time, in directions that are well apart, so that none hides another."""

SPEED = 1.0
"""Metres a second of those who walk, on a straight way across the line of sight."""

FIELD = (45.0, 44.0, 180.0, 180.0)
"""Degrees up, down, left and right, that the hall's scanner sees, as its owner would declare them."""


@dataclass(frozen=True)
class Walk:
    """Where a person's axis is at each of the first scans, (THERE, 2) metres, and the floor's height there."""

    way: np.ndarray
    floor: np.ndarray


def people(true: Truth, rng: np.random.Generator, step: float) -> list[Walk]:
    """``PEOPLE`` walks of ``step`` metres a scan over open floor, each direction's own."""
    walks: list[Walk] = []
    turn = rng.uniform(0.0, 2.0 * math.pi)
    for k in range(PEOPLE):
        for _ in range(200):
            bearing = turn + 2.0 * math.pi * (k + rng.uniform(0.3, 0.7)) / PEOPLE
            off = rng.uniform(NEAR, FAR)
            middle = off * np.array([math.cos(bearing), math.sin(bearing)])
            across = np.array([-math.sin(bearing), math.cos(bearing)])
            way = middle + np.outer(np.arange(THERE) - THERE // 2, across * step)
            if floor := _floors(way, true):
                walks.append(Walk(way, np.array(floor)))
                break
    return walks


def _floors(way: np.ndarray, true: Truth) -> list[float]:
    """The floor's height at each place of the way; nothing if something stands there."""
    floors = []
    for x, y in way:
        around = np.hypot(true.grid.x - x, true.grid.y - y) < RADIUS + 0.1
        if not true.bare[around].all():
            return []
        floors.append(float(true.floor[around].mean()))
    return floors


def put_in(
    points: np.ndarray, pose: np.ndarray, centre: np.ndarray, floor: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """The scan (sensor's axes) with a person in it, and which returns are the person's."""
    ranges = np.linalg.norm(points, axis=1)
    beams = points / np.maximum(ranges, 1e-9)[:, None] @ pose[:3, :3].T
    meets = Post(float(centre[0]), float(centre[1]), RADIUS, floor, floor + TALL).meet(pose[:3, 3], beams)
    own = meets < ranges
    changed = points.copy()
    changed[own] *= ((meets[own] + rng.normal(0.0, NOISE, own.sum())) / ranges[own])[:, None]
    return changed, own


def blocked(
    surface: str, hall: Hall, true: Truth, seed: int, rounds: int, step: float, model: str, limits: Limits | None = None
) -> tuple[float, float]:
    """Percent of the open cells that returned something of a person which are forbidden: in the last scan that sees
    people, and 2 s after. Over ``rounds`` maps of ``PEOPLE`` people each."""
    cells = while_there = after = 0
    for turn in range(rounds):
        rng = np.random.default_rng([seed, turn, round(step * 100)])
        with make_map(surface, model) as made:
            was = np.zeros(true.open.shape, bool)
            walks = people(true, rng, step)
            for scan in range(THERE + GONE):
                points = hall.points[scan]
                own = np.zeros(len(points), bool)
                for walk in walks if scan < THERE else ():
                    points, mine = put_in(points, hall.poses[scan], walk.way[scan], walk.floor[scan], rng)
                    own |= mine
                placed = points[own] @ hall.poses[scan, :3, :3].T + hall.poses[scan, :3, 3]
                was |= true.grid.hits(placed) > 0
                sweep = hall.sweeps([*hall.points[:scan], points, *hall.points[scan + 1 :]], limits)[scan]
                add(made, surface, sweep)
                if scan == THERE - 1:
                    then = seen(made, surface, BOX)
            now = seen(made, surface, BOX)
        was &= true.open
        cells += int(was.sum())
        while_there += int(then.forbidden[was].sum())
        after += int(now.forbidden[was].sum())
    return 100.0 * while_there / cells, 100.0 * after / cells


def rows(hall: Hall, true: Truth, seed: int, rounds: int, model: str) -> list[Row]:
    """People who stood for 3.5 s, or walked through at 1 m/s, 2 s after they left; with and without a declared field
    of view."""
    made = []
    for what, step in (("stood", 0.0), ("walked", SPEED * 0.5)):
        before = blocked("all", hall, true, seed, rounds, step, model)
        for fov, mark in ((None, 8.0), (FIELD, 1.0)):
            then, now = blocked("ground", hall, true, seed, rounds, step, model, Limits(fov=fov))
            on = f"hall, {model}" + (", field of view declared" if fov else "")
            note = f"of {then:.0f} % in the last scan that saw them; {rounds * PEOPLE} people"
            made.append(Row(on, f"a person who {what}: cells blocked 2 s later", "%", now, mark, before=before[1],
                            note=note))  # fmt: skip
    return made
