"""The world of the simulated rover: the ground, what is built and grows on it, and who moves about.

The eastern loop of the path lies in a yard: a roof and a tunnel to drive under, a bridge, a pavement, a puddle before
the wall, a glass wall. The west is wild: trees, tall grass, ditches. People walk and a car leaves; after `CYCLE_S` all
of it begins again. A share of all beams hits a rain drop.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from roughmap_service.simulation.ground import PUDDLE, Ground
from roughmap_service.simulation.solids import BOX, CYLINDER, ELLIPSOID, SOLID, Solids, solid

CYCLE_S = 72.0
"""Seconds after which those who move begin again: two rounds of a rover."""

RAIN = 0.001
"""Share of beams that end at a rain drop somewhere on their way."""

NO_PUDDLE = (0.0, 0.0, 0.0, 0.0)

LEAVES, GRASS = 1.5, 3.0
"""Mean hits per metre of a beam's way."""

TREES = (
    (-8.5, 9.2, 2.3, 3.4),
    (-12.5, 6.2, 2.4, 2.4),
    (-7.5, 0.0, 2.4, 2.6),
    (-16.0, -7.5, 1.1, 1.8),
    (-3.0, -12.0, 2.3, 2.3),
    (6.0, -11.5, 1.2, 1.6),
    (12.8, 6.8, 2.3, 2.2),
    (12.8, -6.8, 2.2, 1.9),
    (11.0, 10.2, 2.3, 1.7),
    (-18.0, 2.5, 2.2, 2.4),
    (-10.5, -13.0, 2.3, 2.0),
)
"""x, y, height of the canopy's underside over the ground, its radius, metres. Under 2 m no robot passes."""

GRASS_PATCH = (-8.2, -3.9, -5.2, -1.9)
"""The box of the tall grass: least x, least y, greatest x, greatest y."""


class Mover(NamedTuple):
    """Who moves: (seconds, x, y) from point to point; `parts` stand where it is, their z from the ground there."""

    way: tuple[tuple[float, float, float], ...]
    parts: Solids


PERSON = np.concatenate(
    [solid(CYLINDER, (0.0, 0.0, 0.75), (0.24, 0.24, 0.75)), solid(ELLIPSOID, (0.0, 0.0, 1.62), (0.12, 0.12, 0.15))]
)

CAR = np.concatenate(
    [solid(BOX, (0.0, 0.0, 0.55), (2.1, 0.9, 0.37)), solid(BOX, (-0.2, 0.0, 1.18), (1.2, 0.8, 0.28))]
    + [solid(BOX, (x, y, 0.2), (0.3, 0.1, 0.3)) for x in (-1.3, 1.3) for y in (-0.8, 0.8)]
)

MOVERS = (
    # One crosses the western loop and the yard's border on foot.
    Mover(((0.0, -15.0, 10.0), (18.7, 3.5, -8.5), (36.0, 15.6, -20.6)), PERSON),
    # One stands within the western loop for 20 s, then leaves between glass and tunnel.
    Mover(((0.0, -3.5, 0.8), (20.0, -3.5, 0.8), (26.7, 3.0, -6.0), (42.7, 3.0, -28.4)), PERSON),
    # A car is parked beside the western bend for 22 s.
    Mover(((0.0, -15.0, -3.0), (22.0, -15.0, -3.0), (24.0, -20.0, -3.0), (26.0, -35.0, -3.0)), CAR),
)


@dataclass(frozen=True)
class World:
    """The ground and what is on it. `puddle` (centre and half axes, metres) is a mirror on level ground."""

    ground: Ground
    fixed: Solids
    movers: tuple[Mover, ...] = ()
    puddle: tuple[float, float, float, float] = NO_PUDDLE
    rain: float = 0.0

    def solids(self, seconds: float) -> Solids:
        """Return all that stands or hangs at a time, in seconds after the start; who has left is not in it."""
        now = seconds % CYCLE_S
        there = [self._placed(mover, now) for mover in self.movers if now <= mover.way[-1][0]]
        return np.concatenate([self.fixed, *there])

    def _placed(self, mover: Mover, now: float) -> Solids:
        times, xs, ys = np.asarray(mover.way).T
        x, y = np.interp(now, times, xs), np.interp(now, times, ys)
        parts = mover.parts.copy()
        parts["x"] += x
        parts["y"] += y
        parts["z"] += float(self.ground.height(x, y))
        return parts


def bare(seed: int) -> World:
    """Return the ground of a seed alone."""
    return World(Ground(seed), np.empty(0, SOLID))


def inhabited(seed: int) -> World:
    """Return the ground of a seed with everything on it."""
    ground = Ground(seed)
    rng = np.random.default_rng([seed, 0x50D])
    parts = [*_roof(ground), *_tunnel(ground), *_bridge(ground), _glass(ground), *_trees(ground), *_grass(ground, rng)]
    return World(ground, np.concatenate(parts), MOVERS, PUDDLE, RAIN)


def _span(ground: Ground, x0: float, y0: float, x1: float, y1: float) -> tuple[float, float]:
    """Return the lowest and highest ground in a box."""
    height = ground.height(np.linspace(x0, x1, 41)[:, None], np.linspace(y0, y1, 41)[None, :])
    return float(height.min()), float(height.max())


def _block(x0: float, y0: float, x1: float, y1: float, z0: float, z1: float, share: float = 1.0) -> Solids:
    centre = ((x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2)
    return solid(BOX, centre, ((x1 - x0) / 2, (y1 - y0) / 2, (z1 - z0) / 2), share=share)


def _roof(ground: Ground) -> list[Solids]:
    """Four posts and a roof, 2.5 m or more over the north-eastern bend."""
    low, high = _span(ground, 4.5, 3.2, 9.5, 8.0)
    under = high + 2.5
    posts = [_block(x, y, x + 0.15, y + 0.15, low - 0.1, under) for x in (4.5, 9.35) for y in (3.2, 7.85)]
    return [_block(4.2, 3.0, 9.8, 8.3, under, under + 0.2), *posts]


def _tunnel(ground: Ground) -> list[Solids]:
    """Two walls and a ceiling at 2.3 m or more around the south-eastern bend."""
    low, high = _span(ground, 4.9, -7.5, 9.2, -3.6)
    under = high + 2.3
    walls = [_block(4.9, y, 9.2, y + 0.3, low - 0.1, under) for y in (-7.5, -3.9)]
    return [_block(4.9, -7.5, 9.2, -3.6, under, under + 0.3), *walls]


def _bridge(ground: Ground) -> list[Solids]:
    """Two piers and a deck, 2.3 m or more over the easternmost point of the path."""
    low, high = _span(ground, 7.5, -1.2, 14.5, 1.2)
    under = high + 2.3
    piers = [_block(x, -1.2, x + 0.5, 1.2, low - 0.1, under) for x in (8.0, 13.6)]
    return [_block(7.5, -1.2, 14.5, 1.2, under, under + 0.4), *piers]


def _glass(ground: Ground) -> Solids:
    """A wall of glass in the south: three beams of ten come back, the others go through."""
    low, high = _span(ground, -4.0, -8.51, 2.0, -8.49)
    return _block(-4.0, -8.51, 2.0, -8.49, low - 0.1, high + 2.2, share=0.3)


def _trees(ground: Ground) -> list[Solids]:
    made = []
    for x, y, under, radius in TREES:
        base, half = float(ground.height(x, y)), 0.45 * radius
        top = base + under + half
        made.append(solid(CYLINDER, (x, y, (base - 0.2 + top) / 2), (0.18, 0.18, (top - base + 0.2) / 2)))
        made.append(solid(ELLIPSOID, (x, y, base + under + half), (radius, radius, half), density=LEAVES))
    return made


def _grass(ground: Ground, rng: np.random.Generator) -> list[Solids]:
    """Tufts of grass, 0.3 to 0.7 m tall, that a robot drives through."""
    x0, y0, x1, y1 = GRASS_PATCH
    made = []
    for x, y, height in zip(rng.uniform(x0, x1, 60), rng.uniform(y0, y1, 60), rng.uniform(0.3, 0.7, 60), strict=True):
        base = float(ground.height(x, y)) - 0.1
        half = (0.22, 0.22, (height + 0.1) / 2)
        made.append(solid(CYLINDER, (x, y, base + half[2]), half, density=GRASS, soft=True))
    return made
