"""People put into the recorded hall: they stand or walk on its open floor, and leave. What they were must go with them.

A person is an upright cylinder. Of a recorded scan, the beams that meet it return from it instead of from where they
did; so it hides what is behind it, and the hall around it is the recorded one.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from right_cast import Post
from right_hall import AT_FLOOR, BOX, Truth
from right_maps import add, make_map, seen
from right_recordings import Hall
from right_row import Row
from scipy.spatial import cKDTree

from roughmap import Limits

RADIUS, TALL = 0.25, 1.75
"""Metres."""

NOISE = 0.01
"""Standard deviation of the person's ranges, metres: clothes."""

BEFORE, THERE, GONE = 3, 7, 4
"""Scans before people come, that see them (3.5 s), and after they left, until the map is judged (2 s): all 14. A cell
that was never seen without the person has the person for its ground; that is another matter."""

NEAR, FAR = 2.5, 8.0
"""Metres from the scanner: where people are put. Farther than a / 0.0105 = 9.5 m no scanner of this resolution
decides whether a cell is empty, and ghosts stay."""

PEOPLE = 5
"""At a time, in directions that are well apart, so that none hides another."""

SPEED = 1.0
"""Metres a second of those who walk, on a straight way across the line of sight."""

FIELD = (45.0, 44.0, 180.0, 180.0)
"""Degrees up, down, left and right, that the hall's scanner sees, as its owner would declare them."""


BACKED = 0.98
"""Share of a person's outline behind which the recording must have returns for it to stand before something. Half of
the hall's directions just below the horizon return nothing."""


@dataclass(frozen=True)
class Walk:
    """Where a person's axis is at each of the first scans, (THERE, 2) metres, and the floor's height there."""

    way: np.ndarray
    floor: np.ndarray


def people(hall: Hall, true: Truth, rng: np.random.Generator, step: float, backed: bool) -> list[Walk]:
    """Up to ``PEOPLE`` walks of ``step`` metres a scan over bare floor, each direction's own; where ``backed``, only
    before what returns."""
    background = hall.placed(0) - hall.poses[0, :3, 3]
    seen = cKDTree(_directions(background))
    walks: list[Walk] = []
    turn = rng.uniform(0.0, 2.0 * math.pi)
    for k in range(PEOPLE):
        for _ in range(200):
            bearing = turn + 2.0 * math.pi * (k + rng.uniform(0.3, 0.7)) / PEOPLE
            off = rng.uniform(NEAR, FAR)
            middle = off * np.array([math.cos(bearing), math.sin(bearing)])
            across = np.array([-math.sin(bearing), math.cos(bearing)])
            way = middle + np.outer(np.arange(THERE) - THERE // 2, across * step)
            floor = _floors(way, true)
            if floor and (not backed or all(_backing(seen, w, f) > BACKED for w, f in zip(way, floor, strict=True))):
                walks.append(Walk(way, np.array(floor)))
                break
    return walks


def _directions(points: np.ndarray) -> np.ndarray:
    """Azimuth and elevation, degrees (N, 2), of points from the sensor, in the map's axes."""
    level = np.hypot(points[:, 0], points[:, 1])
    return np.degrees(np.column_stack([np.arctan2(points[:, 1], points[:, 0]), np.arctan2(points[:, 2], level)]))


def _backing(seen: cKDTree, at: np.ndarray, floor: float) -> float:
    """Share of the directions in a person's outline, from 0.3 m over the floor up, with two returns within 0.9 degrees:
    about what clearing looks at."""
    off = float(np.hypot(*at))
    side = np.linspace(-RADIUS, RADIUS, 9)
    up = np.arange(floor + 0.3, floor + TALL, 0.05)
    across = np.array([-at[1], at[0]]) / off
    places = [np.column_stack([np.tile(at + s * across, (len(up), 1)), up]) for s in side]
    return float((seen.query(_directions(np.concatenate(places)), k=2)[0][:, 1] < 0.9).mean())


def _floors(way: np.ndarray, true: Truth) -> list[float]:
    """The floor's height at each place of the way; nothing if something stands there."""
    floors = []
    for x, y in way:
        (j,), (i,) = true.grid.where(np.array([[x, y]]))
        near = np.s_[max(j - 5, 0) : j + 6, max(i - 5, 0) : i + 6]
        around = np.hypot(true.grid.x[near] - x, true.grid.y[near] - y) < RADIUS + 0.1
        if not true.bare[near][around].all():
            return []
        floors.append(float(true.floor[near][around].mean()))
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


@dataclass(frozen=True)
class Case:
    """``step``: metres a scan that people walk. ``backed``: see `people`. ``rounds``: maps, of ``PEOPLE`` each."""

    step: float
    backed: bool
    seed: int
    rounds: int


class Blocked(NamedTuple):
    """Of the open ``cells`` that returned something of one of ``people``: how many are forbidden in the last scan that
    sees them (``then``) and 2 s after (``left``); and of those left, how many have the person for their ground."""

    people: int
    cells: int
    then: int
    left: int
    ground: int

    @property
    def share(self) -> float:
        """Percent of the cells that are left; NaN of none."""
        return 100.0 * self.left / self.cells if self.cells else math.nan

    @property
    def note(self) -> str:
        return (
            f"{self.left} of {self.cells} cells; {self.then} in the last scan that saw them; {self.people} people; "
            f"{self.ground} have the person for their ground: too few returns of the floor since"
        )


def blocked(surface: str, hall: Hall, true: Truth, case: Case, model: str, limits: Limits) -> Blocked:
    """People in as many maps as the case says, and what is left of them."""
    cells = then = left = ground = number = 0
    for turn in range(case.rounds):
        rng = np.random.default_rng([case.seed, turn])
        walks = people(hall, true, rng, case.step, case.backed)
        was = np.zeros(true.open.shape, bool)
        with make_map(surface, model) as made:
            for scan in range(BEFORE + THERE + GONE):
                points = hall.points[scan]
                own = np.zeros(len(points), bool)
                if BEFORE <= scan < BEFORE + THERE:
                    for walk in walks:
                        at = walk.way[scan - BEFORE], float(walk.floor[scan - BEFORE])
                        points, mine = put_in(points, hall.poses[scan], *at, rng)
                        own |= mine
                was |= true.grid.hits(points[own] @ hall.poses[scan, :3, :3].T + hall.poses[scan, :3, 3]) > 0
                add(made, surface, hall.sweep(scan, points, limits))
                if scan == BEFORE + THERE - 1:
                    while_there = seen(made, surface, BOX)
            now = seen(made, surface, BOX)
        was &= true.open
        number += len(walks)
        cells += int(was.sum())
        then += int(while_there.forbidden[was].sum())
        left += int(now.forbidden[was].sum())
        ground += int((np.abs(now.height - true.floor) > AT_FLOOR)[was & now.forbidden].sum())
    return Blocked(number, cells, then, left, ground)


def rows(hall: Hall, true: Truth, seed: int, rounds: int, model: str) -> list[Row]:
    """People who stood for 3.5 s, or walked through at 1 m/s, 2 s after they left.

    Without a declared field of view they go where they stood before something that returns; elsewhere that only
    informs. With it they go everywhere."""
    made = []
    for what, step in (("stood", 0.0), ("walked", SPEED * 0.5)):
        for on, backed, limits, mark in (
            ("before walls", True, Limits(), 8.0),
            ("anywhere", False, Limits(), None),
            ("anywhere, field of view declared", False, Limits(fov=FIELD), 1.0),
        ):
            case = Case(step, backed, seed, rounds)
            before = blocked("all", hall, true, case, model, Limits()).share if mark else None
            after = blocked("ground", hall, true, case, model, limits)
            figure = f"a person who {what}: cells blocked 2 s later"
            made.append(Row(f"hall, {model}, {on}", figure, "%", after.share, mark, before=before, note=after.note))
    return made
