"""Strays in recorded scans: returns of what is not there. A map that is right hardly notices them."""

import dataclasses

import numpy as np
import right_hall
import right_offroad
from right_maps import Seen
from right_recordings import Hall, Offroad
from right_row import Row

SHARES = {0.001: 0.1, 0.01: 0.5}
"""Share of returns that are strays, and the points of percent that they may cost."""


KINDS = {"in front": False, "half of them behind": True}
"""Rain, dust and insects return before the surface. Mirrors and multiple paths return behind it, mostly below the
ground: no share of these is promised, so they only inform."""


def with_strays(points: np.ndarray, share: float, behind: bool, rng: np.random.Generator) -> np.ndarray:
    """The scan with a share of its returns moved along their beams: evenly between 0.5 m and where they were, or every
    second of them up to 1.5 times as far where ``behind``."""
    moved = points.copy()
    ranges = np.linalg.norm(points, axis=1)
    there = np.flatnonzero(np.isfinite(ranges) & (ranges > 0.5))
    chosen = rng.choice(there, round(share * len(there)), replace=False)
    far, near = (chosen[::2], chosen[1::2]) if behind else (chosen[:0], chosen)
    moved[near] *= (rng.uniform(0.5, ranges[near]) / ranges[near])[:, None]
    moved[far] *= rng.uniform(1.0, 1.5, len(far))[:, None]
    return moved


def hall_rows(hall: Hall, clean: dict[str, Seen], true: right_hall.Truth, seed: int, model: str) -> list[Row]:
    """By how many points of percent more of the open floor is forbidden with strays than without (``clean``: by
    surface). Each scan has strays of its own."""
    made = []
    for kind, behind in KINDS.items():
        for share, mark in SHARES.items():
            rng = np.random.default_rng([seed, round(share * 1e6)])
            sweeps = hall.sweeps([with_strays(own, share, behind, rng) for own in hall.points])
            more = {
                surface: right_hall.forbidden(right_hall.read(surface, sweeps, model), true)
                - right_hall.forbidden(was, true)
                for surface, was in clean.items()
            }
            what = f"{share:.1%} strays {kind}: more open floor forbidden"
            made.append(Row(f"hall, {model}", what, "points", more["ground"], None if behind else mark,
                            before=more["all"]))  # fmt: skip
    return made


def offroad_rows(offroad: Offroad, clean: dict[str, Seen], seed: int, model: str, tries: int = 10) -> list[Row]:
    """By how many points of percent less of the driven track is passable with strays than without, as a mean of
    ``tries`` draws: the track has some hundred cells, so that one cell is a point. This only informs, since a place
    that was seen once is never cleared."""
    made = []
    where = right_offroad.driven(offroad.before, clean["ground"].grid)
    for share in SHARES:
        rng = np.random.default_rng([seed, round(share * 1e6)])
        lost: dict[str, list[float]] = {surface: [] for surface in clean}
        for _ in range(tries):
            points = with_strays(offroad.sweep.scan.points, share, False, rng)
            scan = dataclasses.replace(offroad.sweep.scan, points=points)
            dirty = dataclasses.replace(offroad, sweep=dataclasses.replace(offroad.sweep, scan=scan))
            for surface, was in clean.items():
                now = right_offroad.read(surface, dirty, model)
                lost[surface].append(right_offroad.passable(was, where) - right_offroad.passable(now, where))
        what = f"{share:.1%} strays in front: less of the driven track passable"
        mean, before = float(np.mean(lost["ground"])), float(np.mean(lost["all"]))
        made.append(Row(f"off-road, {model}", what, "points", mean, before=before, note=f"mean of {tries} draws"))
    return made
