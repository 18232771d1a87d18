"""Hypothesis strategies for the map core: points, covariances, poses, scans, cell boxes; and maps as dictionaries.

Hypothesis draws shapes and scales, so that it can shrink them; the many numbers come from a seeded generator.
"""

from typing import Any

import numpy as np
from hypothesis import strategies as st

from roughmap import CELL_DTYPE, TILE_CELLS, Limits, Noise, RoughMap, Scan, Trajectory

MODELS = ("point", "cuboid", "ellipsoid")
WEIGHTED = MODELS[1:]

CENTRES = [(0.0, 0.0, 0.0), (-6.4, 6.4, 12.0), (512_345.67, 5_403_210.98, 431.0)]
"""The origin, the corner of four tiles of 0.1 m cells, and a place in UTM."""

START_NS = 1_700_000_000_000_000_000
SECOND_NS = 1_000_000_000

seeds = st.integers(0, 2**32 - 1)
cell_sizes = st.sampled_from([0.1, 0.25, 1.0])


def turned(axes: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Covariances with these standard deviations (..., 3) along the columns of ``axes`` (..., 3, 3)."""
    S = np.einsum("...ij,...j,...kj->...ik", axes, np.square(sigma), axes)
    return (S + np.swapaxes(S, -1, -2)) / 2


def random_axes(rng: np.random.Generator, number: int) -> np.ndarray:
    """(number, 3, 3) orthogonal matrices of any direction."""
    return np.linalg.qr(rng.normal(size=(number, 3, 3)))[0]


@st.composite
def covariances(draw: st.DrawFn, number: int, least: float = 1e-3, largest: float = 0.1) -> np.ndarray:
    """(number, 3, 3): round ones, long ones in any direction, along the axes, or with one or two sigmas of nearly 0."""
    rng = np.random.default_rng(draw(seeds))
    sigma = np.exp(rng.uniform(np.log(least), np.log(largest), (number, 3)))
    axes = random_axes(rng, number)
    kind = draw(st.sampled_from(["any", "round", "along the axes", "flat", "needle"]))
    if kind == "round":
        sigma[:] = sigma[:, :1]
    elif kind == "along the axes":
        axes[:] = np.eye(3)
    elif kind == "flat":
        sigma[:, 0] = draw(st.sampled_from([0.0, 1e-12, 1e-6]))
    elif kind == "needle":
        sigma[:, :2] = draw(st.sampled_from([0.0, 1e-12, 1e-6]))
    return turned(axes, sigma)


@st.composite
def points(draw: st.DrawFn, number: int, centres: list[tuple[float, float, float]] = CENTRES) -> np.ndarray:
    """(number, 3) around one of the centres, some exactly on borders of cells of 0.25 m, some of equal height."""
    rng = np.random.default_rng(draw(seeds))
    where = np.asarray(draw(st.sampled_from(centres))) + rng.normal(0, draw(st.sampled_from([0.05, 1.0])), (number, 3))
    if draw(st.booleans()):
        on = rng.random(where.shape) < 0.2
        where[on] = np.round(where[on] * 4) / 4
    return where


@st.composite
def clouds(draw: st.DrawFn, least: int = 1, most: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, covariances and stamps in the map frame; a few points are not finite, a few covariances are invalid."""
    number = draw(st.integers(least, most))
    where, S = draw(points(number)), draw(covariances(number))
    rng = np.random.default_rng(draw(seeds))
    where[rng.random(number) < 0.03, 2] = np.nan
    S[rng.random(number) < 0.03, 1, 1] = -1.0
    return where, S, START_NS + rng.integers(0, 100 * SECOND_NS, number)


@st.composite
def trajectories(draw: st.DrawFn, centres: list[tuple[float, float, float]] = CENTRES) -> Trajectory:
    """Up to five poses over about a second, with small or large turns; quaternions of either sign and any norm."""
    number = draw(st.integers(2, 5))
    rng = np.random.default_rng(draw(seeds))
    gaps = rng.integers(SECOND_NS // (2 * number), 3 * SECOND_NS // number // 2, number)
    stamps = START_NS - draw(st.sampled_from([0, 1, SECOND_NS // 9])) + np.cumsum(gaps) - gaps[0]
    position = np.asarray(draw(st.sampled_from(centres))) + np.cumsum(rng.normal(0, 0.3, (number, 3)), axis=0)
    first = rng.normal(size=4)
    rotation = first / np.linalg.norm(first) + draw(st.sampled_from([0.0, 1e-9, 0.02, 2.0])) * rng.normal(
        size=(number, 4)
    )
    rotation *= rng.choice([-1.0, 1.0], (number, 1)) * rng.uniform(0.1, 3.0, (number, 1))
    factor = rng.normal(size=(number, 6, 6)) * np.array([0.01] * 3 + [0.002] * 3)[:, None]
    return Trajectory(stamps, position, rotation, factor @ factor.swapaxes(1, 2))


@st.composite
def scans(draw: st.DrawFn, most: int = 60) -> Scan:
    """Up to ``most`` returns within a few metres, some missing, with or without per-point times, any mounting."""
    number = draw(st.integers(1, most))
    rng = np.random.default_rng(draw(seeds))
    returns = rng.normal(0, 3.0, (number, 3))
    returns[rng.random(number) < 0.05] = 0.0
    returns[rng.random(number) < 0.03, 1] = np.inf
    if draw(st.booleans()):
        returns = returns.astype(np.float32)
    offsets = None
    if draw(st.booleans()):
        offsets = np.sort(rng.integers(-SECOND_NS // 50, SECOND_NS, number))
    translation, rotation = rng.normal(0, 0.5, 3), rng.normal(size=4)
    return Scan(returns, START_NS, offsets, translation, rotation)


noises = st.builds(
    Noise,
    range_sigma=st.sampled_from([0.0, 0.01, 0.03]),
    range_sigma_per_m=st.sampled_from([0.0, 0.002]),
    range_sigma_per_m2=st.sampled_from([0.0, 0.003]),
    beam_sigma=st.sampled_from([0.0, 0.001, 0.02]),
    mount_sigma=st.sampled_from([None, (0.01, 0.02, 0.0, 0.001, 0.0, 0.002)]),
)

limits = st.builds(
    Limits,
    min_range=st.sampled_from([0.0, 1.0]),
    max_range=st.sampled_from([6.0, np.inf]),
    ceiling=st.sampled_from([0.5, np.inf]),
    ceiling_slope=st.sampled_from([0.0, 0.3]),
    max_pose_gap=st.sampled_from([0.3, np.inf]),
    exclude=st.sampled_from([(), ((-1.0, -1.0, -1.0, 1.0, 0.5, 1.0), (2.0, 0.0, -9.0, 3.0, 9.0, 9.0))]),
)


@st.composite
def cell_boxes(draw: st.DrawFn, reach: int = 70, side: int = 6) -> tuple[int, int, int, int]:
    """Cells (i0, j0, i1, j1), half-open, near the origin and therefore near tile borders."""
    i, j = (draw(st.integers(-reach, reach)) for _ in range(2))
    return i, j, i + draw(st.integers(1, side)), j + draw(st.integers(1, side))


def cells_of(m: RoughMap, level: int = 0) -> dict[tuple[int, int], np.void]:
    """The known cells of a map, by (i, j)."""
    found = {}
    with m.freeze(level) as frozen:
        for x, y in frozen.tiles.tolist():
            records = frozen.records(x, y)
            for j, i in np.argwhere(records["count"] != 0).tolist():
                found[x * TILE_CELLS + i, y * TILE_CELLS + j] = records[j, i].copy()
    return found


def shares_of(m: RoughMap) -> dict[tuple[int, int], float]:
    """The shares of a map's only point: W = p q and W2 = p q^2, so that p = W^2 / W2."""
    cells = cells_of(m)
    assert all(cell["count"] == 1 for cell in cells.values())
    return {place: float(cell["weight"] * (cell["weight"] / cell["weight_sq"])) for place, cell in cells.items()}


def state_of(m: RoughMap) -> tuple[Any, ...]:
    """All state that must stay the same if nothing changes: cells, counters, stamps, sequences of all levels."""
    seen: list[Any] = [m.sequence, m.newest_updated, m.tile_count, m.extent(), m.digest()]
    for level in range(m.levels):
        with m.freeze(level) as frozen:
            seen.append((frozen.tiles.tolist(), frozen.sequences.tolist()))
            seen.append([frozen.stamps(x, y) for x, y in frozen.tiles.tolist()])
    return tuple(seen)


assert CELL_DTYPE.itemsize == 64
