"""Scans that clear: who left is gone after some scans, and the map has the same bytes whatever happens beside."""

import numpy as np
import numpy.typing as npt
import pytest

from roughmap import Limits, Noise, RoughMap, Scan, Trajectory
from roughmap.integration import phases
from roughmap.points.scan import Fov
from roughmap.tiles.shelf import Shelf, copy_known_rows, empty_state
from roughmap.tiles.state import TileState

F8 = npt.NDArray[np.float64]

HEIGHT = 1.2
"""Of the sensor over the floor, which is at 0 m."""

NOISE = Noise(0.01, 0.0, 0.001)
PERSON, HIDDEN, ASIDE = (3.05, 0.55), (8.05, -1.35), (-4.0, 3.0)
"""Of the three, the second is behind the wall at 6 m that is put up later, the third in the open."""

START_NS = 1_700_000_000_000_000_000
WALL_X = 6.0


class Kept(Shelf):
    """A shelf in memory, with room for 100 tiles."""

    def __init__(self) -> None:
        super().__init__()
        self._tiles: dict[int, TileState] = {}
        self.reads = 0

    @property
    def room(self) -> int:
        return 100 - self.used

    def _grow(self) -> None:
        self._extend(100)

    def _recycle(self, place: int) -> None:
        self._free.append(place)

    def write(self, place: int, state: TileState, known: int, based: int) -> None:
        self._tiles[place] = empty_state()
        copy_known_rows(state, self._tiles[place])
        if state.column is None:
            self._tiles[place] = self._tiles[place]._replace(column=None)

    def read(self, place: int, room: TileState) -> bool:
        self.reads += 1
        copy_known_rows(self._tiles[place], room)
        return self._tiles[place].column is not None


def returns(people: list[tuple[float, float]], *, wall: bool) -> F8:
    """What 64 rings of 720 beams return, in the sensor's frame: floor to 40 m, people 1.75 m tall, a wall 3 m high."""
    elevation, azimuth = np.radians(np.linspace(-45, 15, 64)), np.radians(np.arange(0, 360, 0.5))
    e, a = (v.ravel() for v in np.meshgrid(elevation, azimuth, indexing="ij"))
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = np.where(rays[:, 2] < 0, -HEIGHT / rays[:, 2], np.inf)
        far = np.where(floor * np.cos(e) < 40.0, floor, np.inf)
        for x, y in people:
            along = x * np.cos(a) + y * np.sin(a)
            beside = x * np.sin(a) - y * np.cos(a)
            hit = (along - np.sqrt(0.25**2 - beside**2)) / np.cos(e)
            top = HEIGHT + hit * rays[:, 2]
            far = np.where((along > 0) & (hit < far) & (top < 1.75), hit, far)
        if wall:
            hit = WALL_X / rays[:, 0]
            far = np.where((hit > 0) & (hit < far) & (HEIGHT + hit * rays[:, 2] < 3.0), hit, far)
    return np.where(np.isfinite(far)[:, None], rays * np.where(np.isfinite(far), far, 0.0)[:, None], 0.0)


def way(number: int) -> Trajectory:
    stamps = START_NS + np.arange(number) * 200_000_000
    still = np.tile([0.0, 0.0, 0.0, 1.0], (number, 1))
    return Trajectory(stamps, np.zeros((number, 3)), still, np.tile(np.eye(6) * 1e-6, (number, 1, 1)))


def scans() -> list[Scan]:
    """Two with people, then eight without, with the wall."""
    before = [returns([PERSON, HIDDEN, ASIDE], wall=False)] * 2
    after = [returns([], wall=True)] * 8
    return [
        Scan(points, START_NS + n * 200_000_000, translation=(0.0, 0.0, HEIGHT))
        for n, points in enumerate([*before, *after])
    ]


def hits_about(m: RoughMap, where: tuple[float, float]) -> int:
    """Hits over 0.3 m above the floor within 0.4 m of a place."""
    total = 0
    with m.freeze() as frozen:
        for tx, ty in frozen.tiles.tolist():
            state = frozen.state(tx, ty)
            if state is None or state.column is None:
                continue
            i, j = tx * 64 + np.arange(4096) % 64, ty * 64 + np.arange(4096) // 64
            near = np.hypot((i + 0.5) * 0.1 - where[0], (j + 0.5) * 0.1 - where[1]) < 0.4
            for column in state.column[near & (state.column["flags"] != 0)]:
                bins = np.stack([column["bins"] & 15, column["bins"] >> 4], axis=1).ravel()
                bottom = (2 * int(column["base"]) + np.arange(80)) * 0.05
                total += int(bins[bottom > 0.3].sum())
    return total


def run(m: RoughMap, *, clear: bool = True, fov: Fov | None = None) -> list[int]:
    """Add all scans; return how many bins each one cleared."""
    path = way(10)
    return [m.add_scan(scan, path, NOISE, Limits(fov=fov), clear=clear).cleared for scan in scans()]


@pytest.mark.parametrize("model", ["point", "cuboid", "ellipsoid"])
def test_who_left_is_gone_and_nothing_behind_a_wall_is(model: str) -> None:
    with RoughMap(error_model=model, surface="ground") as m, RoughMap(error_model=model, surface="ground") as kept:
        cleared = run(m)
        assert run(kept, clear=False) == [0] * 10
        assert sum(cleared[:2]) < 0.05 * sum(cleared)
        assert cleared[2] > 50
        assert cleared[-1] < cleared[2] / 10
        assert hits_about(kept, PERSON) > 100
        assert hits_about(m, PERSON) == 0
        assert hits_about(m, HIDDEN) == hits_about(kept, HIDDEN) > 20
        assert hits_about(m, (WALL_X, 0.5)) == hits_about(kept, (WALL_X, 0.5)) > 20


def test_who_left_the_open_is_gone_with_a_declared_field_of_view() -> None:
    """Above the horizon nothing returns there: without the field of view that says nothing."""
    left = []
    for fov in (None, (15.0, 45.0, 180.0, 180.0)):
        with RoughMap(error_model="point", surface="ground") as m:
            run(m, fov=fov)
            left.append(hits_about(m, ASIDE))
    assert left[0] > left[1] == 0


def test_a_map_of_all_points_has_nothing_to_clear() -> None:
    with RoughMap(error_model="point", surface="all") as m, RoughMap(error_model="point", surface="all") as other:
        assert run(m) == [0] * 10
        run(other, clear=False)
        assert m.digest() == other.digest()


def test_the_same_bytes_whatever_happens_beside() -> None:
    """More threads; tiles that leave memory before each scan; readers that hold every state, and see it to the end."""
    with RoughMap(threads=1, surface="ground") as m:
        cleared, expected = run(m), m.digest()
    with RoughMap(threads=2, surface="ground") as m:
        assert run(m) == cleared
        assert m.digest() == expected

    shelf = Kept()
    with RoughMap(threads=2, surface="ground", shelf=shelf) as m:
        seen, path = [], way(10)
        for scan in scans():
            m.digest()
            eviction = m.spill(m.tile_count)
            eviction.write()
            eviction.close()
            seen.append(m.add_scan(scan, path, NOISE, clear=True).cleared)
        assert seen == cleared
        assert m.digest() == expected
        assert shelf.reads > 20

    with RoughMap(threads=2, surface="ground") as m:
        readers, digests = [], []
        for scan in scans():
            m.add_scan(scan, path, NOISE, clear=True)
            readers.append(m.freeze())
            with m.freeze() as now:
                digests.append([now.digest(x, y) for x, y in now.tiles.tolist()])
        assert m.digest() == expected
        for frozen, told in zip(readers, digests, strict=True):
            assert [frozen.digest(x, y) for x, y in frozen.tiles.tolist()] == told
            frozen.close()


def test_cleared_tiles_count_as_changed() -> None:
    """Also one that no point of the scan touches: the whole view is of the wall, seen over the person's head."""
    with RoughMap(error_model="point", surface="ground") as m:
        path, (first, *_, last) = way(10), scans()
        m.add_scan(first, path, NOISE)
        wall = last.points[(last.points[:, 0] > 5.9) & (np.abs(last.points[:, 1]) < 3.0)]
        before = m.sequence
        report = m.add_scan(Scan(wall, last.stamp_ns, translation=(0.0, 0.0, HEIGHT)), path, NOISE, clear=True)
        assert report.cleared > 10
        assert [0, 0] in report.tiles.tolist()
        assert [0, 0] in m.changed_tiles(0, before)[0].tolist()


def test_no_memory_halfway_does_not_pass_for_an_unchanged_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """The service goes on after a MemoryError, and its log would say that the scan was not added."""

    def fail(*_: object) -> None:
        raise MemoryError

    with RoughMap(error_model="point") as m:
        path, (first, *_, last) = way(10), scans()
        m.add_scan(first, path, NOISE)
        before = m.digest()
        with monkeypatch.context() as patch:
            patch.setattr(phases, "with_columns", fail)
            with pytest.raises(MemoryError):
                m.add_scan(last, path, NOISE, clear=True)
        assert m.digest() == before
        monkeypatch.setattr(phases, "clear", fail)
        with pytest.raises(RuntimeError, match="memory ran out"):
            m.add_scan(last, path, NOISE, clear=True)


def test_prepared_scans_clear_too_and_a_reset_map_does_not() -> None:
    with RoughMap(error_model="point", surface="ground") as m:
        path, (first, *_, last) = way(10), scans()
        m.add_scan(first, path, NOISE)
        prepared = m.prepare_scan(last, path, NOISE, clear=True)
        assert m.integrate(prepared).cleared > 50
        m.reset()
        assert m.add_scan(last, path, NOISE, clear=True).cleared == 0
