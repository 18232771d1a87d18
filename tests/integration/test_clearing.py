"""Clearing, by its kernels: each bin that a scan saw through is halved, and no other."""

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap import Limits, Noise, Scan, Trajectory, georeference
from roughmap.cell import BASED, COLUMN_DTYPE, PointReason
from roughmap.integration.clearing import REACH, clear_tiles
from roughmap.integration.range_image import AZIMUTHS, ROWS, look_around, range_image
from roughmap.integration.viewpoint import Viewpoint, edges_of, is_inside, viewpoint_of
from roughmap.points.scan import Fov

F8 = npt.NDArray[np.float64]
U1 = npt.NDArray[np.uint8]
Columns = npt.NDArray[np.void]

PIXEL = 0.010471975511965978
"""0.6 degrees in radians; `math.radians` gives the number before."""

UNTURNED = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
LEFTWARD = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
"""The sensor's x axis is the map's y axis."""

ALL_AROUND = (90.0, 90.0, 180.0, 180.0)


def image_of(points: F8, origin: tuple[float, float, float], reason: U1 | None = None) -> npt.NDArray[np.float32]:
    image = np.full((AZIMUTHS, ROWS), np.inf, np.float32)
    x, y, z = (np.ascontiguousarray(points[:, k], np.float64) for k in range(3))
    range_image(x, y, z, np.zeros(len(points), np.uint8) if reason is None else reason, origin, image)
    return image


def clear(
    columns: dict[tuple[int, int], Columns], points: F8, view: Viewpoint, a: float = 0.1, parts: int = 1
) -> tuple[int, npt.NDArray[np.uint64]]:
    """Clear the tiles in place; return the number of halved bins and the changed cells by tile."""
    clear_to, rows = np.empty((AZIMUTHS, ROWS), np.float32), np.zeros(ROWS, np.uint8)
    look_around(image_of(points, view.origin), clear_to, rows)
    tiles = np.array(list(columns), np.int32).reshape(-1, 2)
    address = np.array([column.ctypes.data for column in columns.values()], np.uint64)
    bits, cleared = np.zeros((len(tiles), 64), np.uint64), np.zeros(len(tiles), np.int64)
    tx, ty = np.ascontiguousarray(tiles[:, 0]), np.ascontiguousarray(tiles[:, 1])
    for part in range(parts):
        clear_tiles(part, parts, address, tx, ty, a, view, clear_to, rows, bits, cleared)
    return int(cleared.sum()), bits


def look(origin: tuple[float, float, float], fov: Fov | None = None, axes: tuple[float, ...] = UNTURNED) -> Viewpoint:
    return Viewpoint(origin, axes, edges_of(fov))


def put(columns: dict[tuple[int, int], Columns], i: int, j: int, base: int, bins: dict[int, int]) -> None:
    """Give cell (i, j) a column with these hits by bin."""
    tile = columns.setdefault((i >> 6, j >> 6), np.zeros(4096, COLUMN_DTYPE))
    cell = tile[(j & 63) * 64 + (i & 63)]
    cell["flags"], cell["base"] = BASED, base
    for k, hits in bins.items():
        cell["bins"][k // 2] |= hits << 4 * (k % 2)


def hits(columns: dict[tuple[int, int], Columns], i: int, j: int) -> dict[int, int]:
    bins = columns[i >> 6, j >> 6][(j & 63) * 64 + (i & 63)]["bins"]
    both = np.stack([bins & 15, bins >> 4], axis=1).ravel()
    return {int(k): int(both[k]) for k in np.flatnonzero(both)}


def wall(x: float, low: float = -1.0, high: float = 3.0) -> F8:
    """Returns every 2 cm on a wall across the x axis, 4 m wide."""
    y, z = np.meshgrid(np.arange(-2.0, 2.0, 0.02), np.arange(low, high, 0.02))
    return np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1)


# --- by the definition -----------------------------------------------------------------------------------------------


def by_definition(
    columns: dict[tuple[int, int], Columns], points: F8, view: Viewpoint, fov: Fov | None, a: float
) -> dict[tuple[int, int], dict[int, int]]:
    """What is left of each column, pixel by pixel from a dictionary of returns."""
    ox, oy, oz = view.origin
    seen: dict[tuple[int, int], float] = {}
    for px, py, pz in (points - (ox, oy, oz)).tolist():
        d = math.sqrt(px * px + py * py)
        if d < 0.1 or not 0 <= (row := math.floor((pz / d + math.sqrt(3.0)) / PIXEL)) < 330:
            continue
        pixel = row, azimuth(px, py)
        seen[pixel] = min(seen.get(pixel, math.inf), float(np.float32(d)))
    rows = {row for row, _ in seen}
    left: dict[tuple[int, int], dict[int, int]] = {}
    for (tx, ty), tile in columns.items():
        for n in np.flatnonzero(tile["flags"] & BASED).tolist():
            i, j = tx * 64 + n % 64, ty * 64 + n // 64
            x, y = (i + 0.5) * a - ox, (j + 0.5) * a - oy
            d, left[i, j] = math.sqrt(x * x + y * y), hits(columns, i, j)
            for k, before in hits(columns, i, j).items():
                z = (2 * int(tile["base"][n]) + k + 0.5) * 0.05 - oz
                row = math.floor((z / d + math.sqrt(3.0)) / PIXEL) if d else -1
                if not (0.5 <= d <= a / PIXEL and 1 <= row < 329):
                    continue
                around = [(row + v, (azimuth(x, y) + u) % 600) for v in (-1, 0, 1) for u in (-1, 0, 1)]
                found = [seen[pixel] for pixel in around if pixel in seen]
                near_rows = row > max(rows, default=0) or not rows.isdisjoint({row - 1, row, row + 1})
                free = fov is not None and near_rows and inside(fov, view.axes, x, y, z)
                if not any(r < d + 0.3 for r in found) and (len(found) >= 2 or free):
                    left[i, j][k] = before // 2
            left[i, j] = {k: h for k, h in left[i, j].items() if h}
    return left


def azimuth(x: float, y: float) -> int:
    part = x / (abs(x) + abs(y))
    return min(math.floor(150 * (1 - part if y >= 0 else 3 + part)), 599)


def inside(fov: Fov, axes: tuple[float, ...], x: float, y: float, z: float) -> bool:
    sx, sy, sz = np.array(axes).reshape(3, 3).T @ (x, y, z)
    up, side = math.degrees(math.atan2(sz, math.hypot(sx, sy))), math.degrees(math.atan2(sy, sx))
    return -fov[1] <= up <= fov[0] and -fov[3] <= side <= fov[2]


FOVS = st.none() | st.tuples(st.floats(5, 90), st.floats(5, 90), st.floats(5, 180), st.floats(5, 180))


@examples(60)
@given(seed=st.integers(0, 2**32 - 1), a=st.sampled_from([0.05, 0.1, 0.4]), fov=FOVS, far=st.booleans())
def test_the_bins_that_the_definition_names_are_halved(seed: int, a: float, fov: Fov | None, far: bool) -> None:
    """Points at random over a few tiles, some of them patches as dense as a scan's, seen from a place between them."""
    rng = np.random.default_rng(seed)
    middle = np.array([512_345.67, 5_403_210.98, 431.0]) if far else np.zeros(3)
    origin = middle + rng.uniform(-1, 1, 3)
    rays = rng.normal(size=(4000, 3)) * (1.0, 1.0, 0.3)
    rays[2000:] = rays[2000:2010].repeat(200, axis=0) + rng.normal(0, 0.02, (2000, 3))
    spread = rays / np.linalg.norm(rays, axis=1)[:, None] * rng.uniform(0.05, 250 * a, (4000, 1))
    points = origin + spread
    columns: dict[tuple[int, int], Columns] = {}
    for _ in range(60):
        i, j = np.floor(origin[:2] / a + rng.uniform(-100, 100, 2)).astype(int).tolist()
        if hits_at(columns, i, j):
            continue
        base = math.floor(10 * (origin[2] - rng.uniform(0, 3)))
        put(columns, i, j, base, {int(k): int(rng.integers(1, 16)) for k in rng.choice(80, 12, replace=False)})
    place: tuple[float, float, float] = (float(origin[0]), float(origin[1]), float(origin[2]))
    view = look(place, fov, LEFTWARD)
    expected = by_definition(columns, points, view, fov, a)
    before = {cell: hits(columns, *cell) for cell in expected}
    number, bits = clear(columns, points, view, a)
    assert {cell: hits(columns, *cell) for cell in expected} == expected
    changed = {cell for cell, left in expected.items() if left != before[cell]}
    assert number == sum(h != expected[c].get(k, 0) for c in changed for k, h in before[c].items())
    marked = {
        (tx * 64 + i, ty * 64 + j)
        for (tx, ty), row in zip(columns, bits, strict=True)
        for j in range(64)
        for i in range(64)
        if int(row[j]) >> i & 1
    }
    assert marked == changed


def hits_at(columns: dict[tuple[int, int], Columns], i: int, j: int) -> bool:
    return (i >> 6, j >> 6) in columns and bool(hits(columns, i, j))


# --- what it is for --------------------------------------------------------------------------------------------------


def test_who_left_is_gone_after_four_scans_of_the_wall_behind() -> None:
    columns: dict[tuple[int, int], Columns] = {}
    put(columns, 30, 0, 0, dict.fromkeys(range(20, 34), 15))
    for left in (7, 3, 1):
        clear(columns, wall(6.0), look((0.0, 0.0, 1.0)))
        assert set(hits(columns, 30, 0).values()) == {left}
    assert clear(columns, wall(6.0), look((0.0, 0.0, 1.0)))[0] == 14
    assert hits(columns, 30, 0) == {}
    assert clear(columns, wall(6.0), look((0.0, 0.0, 1.0)))[0] == 0


@pytest.mark.parametrize(
    ("i", "why"),
    [(29, "the wall itself, within 0.3 m"), (45, "behind it"), (4, "nearer than 0.5 m"), (-30, "where no return is")],
)
def test_what_was_not_seen_through_stays(i: int, why: str) -> None:
    columns: dict[tuple[int, int], Columns] = {}
    put(columns, i, 0, 0, dict.fromkeys(range(10, 40), 3))
    clear(columns, wall(3.0), look((0.0, 0.0, 1.0)))
    assert hits(columns, i, 0) == dict.fromkeys(range(10, 40), 3), why


def test_cells_are_cleared_up_to_the_width_of_a_pixel() -> None:
    columns: dict[tuple[int, int], Columns] = {}
    last = math.floor(REACH - 0.5)
    for i in (last, last + 1):
        put(columns, i, 0, 0, {30: 1})
    points = wall(14.0)
    clear(columns, points, look((0.0, 0.05, 1.0)))
    assert (hits(columns, last, 0), hits(columns, last + 1, 0)) == ({}, {30: 1})


@pytest.mark.parametrize(
    ("fov", "axes", "gone"),
    [
        (None, UNTURNED, False),
        (ALL_AROUND, UNTURNED, True),
        ((30.0, 30.0, 20.0, 20.0), UNTURNED, False),
        ((30.0, 30.0, 20.0, 20.0), LEFTWARD, True),
        ((30.0, 30.0, 0.0, 20.0), LEFTWARD, False),
        ((0.5, 30.0, 20.0, 20.0), LEFTWARD, False),
    ],
)
def test_no_return_clears_only_in_a_declared_field_of_view(
    fov: Fov | None, axes: tuple[float, ...], gone: bool
) -> None:
    """The cell lies to the left, a little ahead and above, where nothing returns; the wall ahead has returns in its
    rows."""
    columns: dict[tuple[int, int], Columns] = {}
    put(columns, -6, 30, 0, {24: 1})
    clear(columns, wall(6.0), look((0.0, 0.0, 1.0), fov, axes))
    assert hits(columns, -6, 30) == ({} if gone else {24: 1})


def test_no_return_says_nothing_in_rows_without_one_below_the_highest() -> None:
    """A strip of returns high up: what is between it and the wall may be between the sensor's rings."""
    low, strip = wall(6.0, high=1.8), wall(6.0, low=5.5, high=5.7)
    for points, left in ((low, {}), (np.concatenate([low, strip]), {60: 1})):
        columns: dict[tuple[int, int], Columns] = {}
        put(columns, -6, 30, 0, {24: 1, 60: 1})
        clear(columns, points, look((0.0, 0.0, 1.0), ALL_AROUND))
        assert hits(columns, -6, 30) == left


# --- exactness -------------------------------------------------------------------------------------------------------


def test_the_points_with_a_pose_make_the_image() -> None:
    """Those that the map does not use have been measured all the same; the others have no place."""
    for reason in PointReason:
        image = image_of(np.array([[3.0, 1.0, 0.2]]), (0.0, 0.0, 0.0), np.array([reason], np.uint8))
        assert np.isfinite(image).sum() == (reason == PointReason.KEPT or reason >= PointReason.SELF)


@examples(30)
@given(seed=st.integers(0, 2**32 - 1), cut=st.integers(0, 900))
def test_the_order_of_points_and_the_cutting_do_not_matter(seed: int, cut: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(900, 3)) * rng.choice([0.05, 1.0, 20.0, 1e200], (900, 1))
    points[::50] = rng.choice([0.0, -0.0, 0.1], (18, 3))
    whole = image_of(points, (0.0, 0.0, 0.0))
    mixed = points[rng.permutation(900)]
    assert image_of(mixed, (0.0, 0.0, 0.0)).tobytes() == whole.tobytes()
    both = np.minimum(image_of(mixed[:cut], (0.0, 0.0, 0.0)), image_of(mixed[cut:], (0.0, 0.0, 0.0)))
    assert both.tobytes() == whole.tobytes()


def test_the_order_of_tiles_and_the_parts_do_not_matter() -> None:
    rng = np.random.default_rng(5)
    columns: dict[tuple[int, int], Columns] = {}
    for i, j in rng.integers(-95, 95, (800, 2)).tolist():
        if not hits_at(columns, i, j):
            put(columns, i, j, 0, {int(k): int(rng.integers(1, 16)) for k in rng.choice(80, 9, replace=False)})
    points = rng.normal(size=(60_000, 3)) * (12.0, 12.0, 3.0)
    view = look((0.3, -0.2, 1.1), (40.0, 40.0, 120.0, 120.0))
    backward = {tile: columns[tile].copy() for tile in sorted(columns, reverse=True)}
    number, _ = clear(columns, points, view)
    assert number > 500
    assert clear(backward, points, view, parts=3)[0] == number
    for tile, column in columns.items():
        assert backward[tile].tobytes() == column.tobytes()


@examples(200)
@given(up=st.floats(0, 90), side=st.floats(0, 180), where=st.floats(-180, 180), above=st.floats(-89, 89))
def test_the_edges_of_a_field_of_view_are_where_the_angles_say(
    up: float, side: float, where: float, above: float
) -> None:
    """1e-6 degrees from an edge both may say either."""
    fov = (up, 90.0 - up / 2.0, side, 180.0 - side / 2.0)
    if min(abs(above - up), abs(above + fov[1]), abs(where - side), abs(where + fov[3])) < 1e-6:
        return
    r, flat = math.radians(where), math.cos(math.radians(above))
    x, y, z = flat * math.cos(r), flat * math.sin(r), math.sin(math.radians(above))
    assert bool(is_inside(UNTURNED, edges_of(fov), x, y, z)) == inside(fov, UNTURNED, x, y, z)


# --- from where ------------------------------------------------------------------------------------------------------


def test_the_view_is_from_where_the_first_accepted_point_was_measured() -> None:
    """The sensor moves and turns within the sweep; the first points are too near, so that the fourth decides."""
    stamps = np.array([0, 100_000_000, 250_000_000])
    turns = np.array([[0.0, 0.0, 0.0, 1.0], [0.1, 0.0, 0.3, 0.9], [0.2, -0.2, 0.6, 0.7]])
    way = Trajectory(stamps, np.array([[5e5, 5e6, 40.0], [5e5 + 2, 5e6 + 1, 40.2], [5e5 + 4, 5e6, 41.0]]), turns,
                     np.zeros((3, 6, 6)))  # fmt: skip
    points = np.array([[0.1, 0.0, 0.1]] * 3 + [[4.0, 1.0, -0.5]] * 3)
    offsets = np.array([0, 20, 40, 170, 190, 210]) * 1_000_000
    scan = Scan(points, 3, offsets, (0.4, 0.1, 1.2), (0.1, -0.2, 0.3, 0.9))
    limits = Limits(min_range=1.0)
    placed = georeference(scan, way, Noise(0.01), limits)
    view = viewpoint_of(scan, way, limits, placed.reason)
    seen = np.array(view.origin) + np.array(view.axes).reshape(3, 3) @ points[3]
    # Rounding at 5e6 m is 1e-9 m.
    np.testing.assert_allclose(seen, placed.points[3], rtol=0, atol=4e-9)
    assert np.abs(seen - placed.points[4]).max() > 0.01


@pytest.mark.parametrize("fov", [(-1, 0, 0, 0), (91, 0, 0, 0), (0, 0, 181, 0), (0, 0, 0), (0, math.nan, 0, 0), "abcd"])
def test_a_field_of_view_that_is_none_is_refused(fov: Fov) -> None:
    with pytest.raises(ValueError, match=r"Limits\.fov"):
        Limits(fov=fov)
