"""Things of known size, put before a robot that drives up to them: does the map call free what is not, or the reverse?

Each placement is a draw by seed: the thing's size, the scanner's height, how the cells lie to it, noise.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from right_cast import Axes, Block, Scanner, Shape, Slab, drive
from right_maps import Seen, built, seen
from right_row import Row
from scipy.ndimage import binary_dilation, label
from scipy.spatial.transform import Rotation

PLACED = 200
"""Of each kind."""

WIDE = 60.0
"""Metres: what goes across the way goes on and on."""

STRETCH = 0.75
"""Metres to either side of the way, between which the robot might try to get across."""

ROBOT = 0.15
"""Half the width of the smallest robot that is thought of, metres."""

STEP = 0.1
"""Metres between sweeps: 1 m/s at 10 Hz."""


@dataclass(frozen=True)
class Placement:
    """``world``: shapes. ``begin``, ``end``: along the way, metres, of what is across it. ``drive_from``, ``drive_to``:
    where the first and the last sweep are taken. ``known``: a drop or a ditch may be unknown instead of forbidden."""

    world: Sequence[Shape]
    begin: float
    end: float
    drive_from: float = -6.0
    drive_to: float = -1.3


def step_up(rng: np.random.Generator) -> Placement:
    """A ledge of 0.25 to 0.6 m, seen from below."""
    high = rng.uniform(0.25, 0.6)
    return Placement([Slab(), Block((0.0, -WIDE, -1.0), (WIDE, WIDE, high))], 0.0, 0.0)


def step_down(rng: np.random.Generator) -> Placement:
    """The same from above. What the ledge hides of the lower ground is unknown."""
    deep = rng.uniform(0.25, 0.6)
    return Placement([Slab(-deep), Block((-WIDE, -WIDE, -5.0), (0.0, WIDE, 0.0))], 0.0, 0.0)


def ditch(rng: np.random.Generator) -> Placement:
    """0.4 to 1.5 m wide, 0.3 to 1 m deep, with upright walls."""
    wide, deep = rng.uniform(0.4, 1.5), rng.uniform(0.3, 1.0)
    banks = [Block((-WIDE, -WIDE, -5.0), (0.0, WIDE, 0.0)), Block((wide, -WIDE, -5.0), (wide + WIDE, WIDE, 0.0))]
    return Placement([Slab(-deep), *banks], 0.0, wide)


def rail(rng: np.random.Generator) -> Placement:
    """2 cm thick, 0.8 m above flat ground: a barrier's bar."""
    middle = 0.8
    return Placement([Slab(), Block((0.0, -WIDE, middle - 0.01), (0.02, WIDE, middle + 0.01))], 0.0, 0.02)


def beam(rng: np.random.Generator) -> Placement:
    """10 to 30 cm thick, its lower side 1.2 m above flat ground."""
    thick = rng.uniform(0.1, 0.3)
    return Placement([Slab(), Block((0.0, -WIDE, 1.2), (thick, WIDE, 1.2 + thick))], 0.0, thick)


def nothing(rng: np.random.Generator) -> Placement:
    """Flat ground: here the robot must get across."""
    return Placement([Slab()], 0.0, 0.0)


def roof(rng: np.random.Generator) -> Placement:
    """10 cm thick, 2.6 m above flat ground, 4 to 8 m long; the robot drives until it is below."""
    long = rng.uniform(4.0, 8.0)
    above = Block((0.0, -WIDE, 2.6), (long, WIDE, 2.7))
    return Placement([Slab(), above], 0.0, long, drive_from=-6.0, drive_to=min(3.0, long - 1.0))


def seen_by_driving(place: Placement, surface: str, model: str, rng: np.random.Generator) -> tuple[Seen, Axes]:
    """The map that the robot has when it stands before the thing, and how the world lies in it."""
    scanner = Scanner()
    high = rng.uniform(0.5, 1.2)
    along = np.arange(place.drive_from, place.drive_to + 1e-9, STEP)
    at = np.column_stack([along, rng.normal(0.0, 0.02, len(along)), np.full(len(along), high)])
    axes = Axes(rng.uniform(0.0, 2.0 * math.pi), tuple(rng.uniform(-3.0, 3.0, 3).tolist()))
    sweeps = drive([place.world] * len(at), at, Rotation.identity(), scanner, axes, rng)
    with built(surface, sweeps, model) as made:
        return seen(made, surface, (-12.0, -12.0, 12.0, 12.0)), axes


def crossed(of: Seen, axes: Axes, place: Placement) -> bool:
    """Whether a robot of 0.3 m that goes only where the map says free gets across, within ``STRETCH`` of the way.

    It needs cells known and free, connected over corners as well, from 0.5 m before the thing to 0.5 m behind it, none
    of which has a forbidden cell within 0.15 m. What is unknown is as good as a wall to it, as it is behind a ledge.
    """
    x, y = axes.local(of.grid.x, of.grid.y)
    reach = math.ceil(ROBOT / of.grid.cell)
    j, i = np.mgrid[-reach : reach + 1, -reach : reach + 1] * of.grid.cell
    may = of.free & ~binary_dilation(of.forbidden, np.hypot(i, j) <= ROBOT + 1e-9)
    within = (np.abs(y) < STRETCH) & (x > place.begin - 0.8) & (x < place.end + 0.8)
    parts, number = label(may & within, np.ones((3, 3)))
    begun, ended = x < place.begin - 0.5, x > place.end + 0.5
    return any((parts[begun] == part).any() and (parts[ended] == part).any() for part in range(1, number + 1))


Draw = Callable[[np.random.Generator], Placement]


def missed(draw: Draw, surface: str, model: str, seed: int, number: int) -> list[int]:
    """The draws whose thing the robot would drive into."""
    found = []
    for k in range(number):
        rng = np.random.default_rng([seed, k])
        place = draw(rng)
        of, axes = seen_by_driving(place, surface, model, rng)
        if crossed(of, axes, place):
            found.append(k)
    return found


def roof_forbidden(surface: str, model: str, seed: int, number: int) -> list[int]:
    """The draws with a forbidden cell on the flat ground below the roof or before it, within ``STRETCH`` of the way."""
    found = []
    for k in range(number):
        rng = np.random.default_rng([seed, k])
        place = roof(rng)
        of, axes = seen_by_driving(place, surface, model, rng)
        x, y = axes.local(of.grid.x, of.grid.y)
        if (of.forbidden & (np.abs(y) < STRETCH) & (x > place.drive_from) & (x < place.end)).any():
            found.append(k)
    return found


def slopes(surface: str, model: str, seed: int, number: int) -> tuple[list[int], np.ndarray]:
    """Planes of 0 to 28 degrees that the robot drives up, down or across: the draws with a forbidden cell, and by how
    many degrees (number,) the median slope of the cells is off.

    The robot stands upright to its ground. Cells are judged within 4 m of its last place, where the ground is dense."""
    found, off = [], []
    for k in range(number):
        rng = np.random.default_rng([seed, k])
        true, turn = math.radians(rng.uniform(0.0, 28.0)), rng.uniform(0.0, 2.0 * math.pi)
        rises = math.tan(true) * np.array([math.cos(turn), math.sin(turn)])
        level = Rotation.from_rotvec(true * np.array([math.sin(turn), -math.cos(turn), 0.0]))
        high = rng.uniform(0.5, 1.2)
        along = np.arange(-3.0, 1e-9, STEP) * math.cos(math.atan(rises[0]))
        at = np.column_stack([along, np.zeros(len(along)), along * rises[0]]) + level.apply([0.0, 0.0, high])
        axes = Axes(rng.uniform(0.0, 2.0 * math.pi), tuple(rng.uniform(-3.0, 3.0, 3).tolist()))
        world = [Slab(0.0, tuple(rises.tolist()))]
        sweeps = drive([world] * len(at), at, level, Scanner(), axes, rng)
        with built(surface, sweeps, model) as made:
            of = seen(made, surface, (-12.0, -12.0, 12.0, 12.0))
        x, y = axes.local(of.grid.x, of.grid.y)
        where = (np.hypot(x, y) < 4.0) & (x > 0.0) & (np.abs(y) < STRETCH) & np.isfinite(of.slope)
        if (of.forbidden & where).any():
            found.append(k)
        off.append(abs(math.degrees(float(np.median(of.slope[where])) - true)))
    return found, np.array(off)


ACROSS = {
    "ledge up of >= 0.25 m": step_up,
    "ledge down of >= 0.25 m": step_down,
    "ditch": ditch,
    "rail of 2 cm at 0.8 m": rail,
    "beam at 1.2 m": beam,
}
"""What a robot must not drive into."""


def rows(seed: int, number: int, model: str) -> list[Row]:
    """All kinds, and flat ground, on which the robot must get across every time: the proof that a miss can be seen."""
    on, made = f"simulated, {model}", []
    of = f"of {number}"
    for name, draw in ACROSS.items():
        bad = missed(draw, "ground", model, seed, number)
        made.append(Row(on, f"{name}: missed", of, len(bad), 0, note=_which(bad)))
    got = missed(nothing, "ground", model, seed, number)
    made.append(Row(on, "flat ground: got across", of, len(got), number, least=True))
    bad = roof_forbidden("ground", model, seed, number)
    made.append(Row(on, "roof at 2.6 m: something forbidden below", of, len(bad), 0, note=_which(bad)))
    bad, off = slopes("ground", model, seed, number)
    made += [
        Row(on, "slopes to 28 degrees: something forbidden", of, len(bad), 0, note=_which(bad)),
        Row(on, "slopes to 28 degrees: median off at most", "degrees", float(off.max()), 0.2),
    ]
    return made


def _which(bad: list[int]) -> str:
    """The first draws, to be looked at."""
    return f"draws {', '.join(map(str, bad[:5]))}" + (", .." if len(bad) > 5 else "") if bad else ""
