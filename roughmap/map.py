"""The map: points in, tiles of cells kept up to date, readings out."""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from types import TracebackType
from typing import Self

import numba
import numpy as np
import numpy.typing as npt

from roughmap.arrays import I4, I8, U1, Records
from roughmap.cell import OFFSET_LIMIT_NS, STAMP_LIMIT_NS, TILE_CELLS, PointReason
from roughmap.integration import blocks
from roughmap.integration.blocks import State
from roughmap.integration.integrate import AddReport, Geometry, Prepared, integrate, prepare
from roughmap.integration.workspace import Planes, ThreadScratch, Workspace
from roughmap.points.checks import checked_covariances, checked_integers, checked_points, checked_stamps
from roughmap.points.place import pose_at
from roughmap.points.scan import Limits, Noise, Scan, scan_rules
from roughmap.points.strided import source_of
from roughmap.points.trajectory import Trajectory
from roughmap.reading.frozen import Frozen
from roughmap.reading.merge_cache import MergeCache
from roughmap.reading.region import Region, cell_box, read_region, tile_box
from roughmap.settings import Settings
from roughmap.tiles import loading
from roughmap.tiles.digest import map_digest
from roughmap.tiles.eviction import Eviction
from roughmap.tiles.index import TileBox, TileVersions, paired
from roughmap.tiles.shelf import Shelf
from roughmap.tiles.table import Hold, TileTable


class RoughMap:
    """A rough-ground map of any extent, built point by point.

    ``cell_size`` metres; ``error_model`` "point", "cuboid" or "ellipsoid"; ``coverage``: how many sigmas the error body
    spans; ``min_radius`` metres, its least half extent; ``min_distance`` metres, the least distance in eq. 16;
    ``min_share``: a cell takes part if its share is at least this part of the point's largest;
    ``max_horizontal_radius`` metres, beyond which a point is too uncertain; ``bounds`` (xmin, ymin, xmax, ymax) metres,
    half-open; ``levels``, level 0 included; ``threads`` that share the work (None: numba's number); ``shelf``: where
    tiles go that `spill` takes out of memory.

    The same points, covariances and stamps in the same order give the same bytes of state, however they were cut into
    calls and however many threads worked on them. One thread at a time may call the methods, but for `prepare`: what
    stands there, and the thread that changes the map may call `digest` while others call `freeze`. What `freeze` gives
    may be read by others meanwhile. Errors in arguments are ValueError, and nothing is changed then.
    """

    def __init__(
        self,
        cell_size: float = 0.1,
        error_model: str = "cuboid",
        coverage: float = 2.0,
        min_radius: float = 1e-3,
        min_distance: float = 1e-3,
        min_share: float = 0.05,
        max_horizontal_radius: float = 0.5,
        bounds: Sequence[float] | None = None,
        levels: int = 8,
        threads: int | None = None,
        *,
        shelf: Shelf | None = None,
    ) -> None:
        self.settings = Settings(
            cell_size=cell_size,
            error_model=error_model,
            coverage=coverage,
            min_radius=min_radius,
            min_distance=min_distance,
            min_share=min_share,
            max_horizontal_radius=max_horizontal_radius,
            bounds=bounds,
            levels=levels,
        )
        threads = numba.config.NUMBA_NUM_THREADS if threads is None else threads  # type: ignore[attr-defined]
        if not isinstance(threads, int) or not 1 <= threads <= 256:
            raise ValueError(f"threads: expected an integer in [1, 256] or None, got {threads!r}")
        self.sequence = 0
        """+1 for each call that accepted a point, and for each `reset`."""
        self.newest_updated = 0
        """The largest `updated` of any cell, in seconds; 0 if the map is empty."""
        self._space = Workspace(threads, self.settings.side)
        self._table = TileTable(levels, shelf or Shelf())
        self._cache = MergeCache()
        self._digest = ((-1, 0), "")  # the last one asked for, and of which sequence and generation

    @property
    def cell_size(self) -> float:
        """Side of a cell of level 0, metres."""
        return self.settings.cell_size

    @property
    def levels(self) -> int:
        """Number of levels, level 0 included."""
        return self.settings.levels

    @property
    def tile_count(self) -> int:
        """Level-0 tiles with a known cell."""
        return self._table.size

    @property
    def resident_tiles(self) -> int:
        """Those of them that are in memory; the others are on the shelf."""
        return self._table.resident

    @property
    def memory_bytes(self) -> int:
        """Bytes of tiles (counted whole), tables and merged levels; what is resident may be less."""
        return self._table.nbytes + self._cache.nbytes

    def tile_sequences(self, level: int = 0, box: TileBox | None = None) -> tuple[I4, I8]:
        """(T, 2) tiles of a level in ``box`` (inclusive; None: all), ascending by (x, y), and (T,) their sequences."""
        tx, ty, sequence = self._table.levels[level].select(box)
        return paired(tx, ty), sequence

    def changed_tiles(self, level: int, after: int) -> tuple[I4, I8]:
        """The same of the tiles whose sequence is larger than ``after``."""
        index = self._table.levels[level]
        entries = index.changed(after)
        return paired(index.tx[entries], index.ty[entries]), index.sequence[entries]

    def tile_versions(self) -> list[TileVersions]:
        """Of each level the tiles and their sequences as they are now, to be read while the map goes on."""
        return [level.versions() for level in self._table.levels]

    def extent(self) -> tuple[float, float, float, float] | None:
        """xmin, ymin, xmax, ymax in metres of the tiles with a known cell; None if there is none."""
        base = self._table.levels[0]
        if not base.size:
            return None
        tx, ty = base.tx[: base.size], base.ty[: base.size]
        low = int(tx.min()) * TILE_CELLS, int(ty.min()) * TILE_CELLS
        high = (int(tx.max()) + 1) * TILE_CELLS, (int(ty.max()) + 1) * TILE_CELLS
        a = self.cell_size
        return low[0] * a, low[1] * a, high[0] * a, high[1] * a

    def add(
        self,
        points: npt.ArrayLike,
        covariance: npt.ArrayLike | None = None,
        stamp_ns: npt.ArrayLike = 0,
        *,
        offsets_ns: npt.ArrayLike | None = None,
        max_new_tiles: int | None = None,
        max_tiles: int | None = None,
    ) -> AddReport:
        """Take up points (N, 3) in the map frame, in metres.

        ``covariance`` (N, 3, 3), or (3, 3) for all alike, square metres in map axes, only the upper triangles read;
        needed unless the model is "point", which does not look at it. ``stamp_ns``: one integer or (N,), in
        [0, 2^32 s). ``offsets_ns`` (N,): added to the stamps; a point whose offset is negative or beyond 1 s is
        rejected as `time`. `TooManyTiles` if more than ``max_new_tiles`` tiles would be new or the map would have more
        than ``max_tiles``; no cell is written then.
        """
        return self.integrate(
            self.prepare(
                points, covariance, stamp_ns, offsets_ns=offsets_ns, max_new_tiles=max_new_tiles, max_tiles=max_tiles
            )
        )

    def add_scan(
        self,
        scan: Scan,
        trajectory: Trajectory,
        noise: Noise,
        limits: Limits | None = None,
        *,
        max_new_tiles: int | None = None,
        max_tiles: int | None = None,
    ) -> AddReport:
        """Place a scan (eq. 1) and take up its points; equal to `georeference` and `add`, to the bit.

        No covariance array is made: each block of points is placed, bounded, and its covariances forgotten.
        ``max_new_tiles``, ``max_tiles``: as in `add`.
        """
        return self.integrate(
            self.prepare_scan(scan, trajectory, noise, limits, max_new_tiles=max_new_tiles, max_tiles=max_tiles)
        )

    def prepare(
        self,
        points: npt.ArrayLike,
        covariance: npt.ArrayLike | None = None,
        stamp_ns: npt.ArrayLike = 0,
        *,
        offsets_ns: npt.ArrayLike | None = None,
        max_new_tiles: int | None = None,
        max_tiles: int | None = None,
        hold: Hold = nullcontext,
    ) -> Prepared:
        """All of an `add` before the change that readers see: points are bounded, tiles brought into memory.

        The one thread that changes the map may call it while others call `freeze`, under a lock that it need not hold:
        ``hold`` gives it for moments, not while tiles are read from the shelf. What this raises leaves the map as it
        was. Next comes `integrate`, under the lock.
        """
        checked = checked_points(points, "points")
        number = len(checked)
        matrices = checked_covariances(covariance, number, self.settings.error_model)
        stamps = checked_stamps(stamp_ns, number)
        late = None
        if offsets_ns is not None:
            offsets = checked_integers(offsets_ns, (number,), "offsets_ns")
            late = (offsets < 0) | (offsets > OFFSET_LIMIT_NS)
            stamps = stamps + np.where(late, 0, offsets)
            late |= stamps >= STAMP_LIMIT_NS
        planes = self._space.planes(number)
        if late is not None:
            planes.reason[:number][late & np.isfinite(checked).all(axis=1)] = PointReason.TIME
        source, rules = source_of(checked), self.settings.rules

        def bound(start: int, stop: int, scratch: ThreadScratch, state: State) -> tuple[int, State]:
            return blocks.point_blocks(
                start, stop, planes, scratch.block, source, matrices, rules, scratch.tiles.arrays, state
            )

        return self._prepare(number, planes, stamps, bound, max_new_tiles, max_tiles, hold)

    def prepare_scan(
        self,
        scan: Scan,
        trajectory: Trajectory,
        noise: Noise,
        limits: Limits | None = None,
        *,
        max_new_tiles: int | None = None,
        max_tiles: int | None = None,
        hold: Hold = nullcontext,
    ) -> Prepared:
        """The same of an `add_scan`."""
        limits = limits or Limits()
        number = len(scan.points)
        offsets = scan.times
        stamps = scan.stamp_ns + (np.zeros(1, np.int64) if scan.offsets_ns is None else offsets)
        way, gap, rules = trajectory.arrays, limits.max_gap_ns, scan_rules(scan, noise, limits)
        posed, pose = pose_at(way, gap, scan.stamp_ns)
        planes = self._space.planes(number)
        source, own = source_of(scan.points), self.settings.rules

        def place(start: int, stop: int, scratch: ThreadScratch, state: State) -> tuple[int, State]:
            return blocks.scan_blocks(
                start, stop, planes, scratch.block, source, offsets, scan.offsets_ns is not None, scan.stamp_ns, way,
                gap, posed, pose, rules, own, scratch.tiles.arrays, state,
            )  # fmt: skip

        return self._prepare(number, planes, stamps, place, max_new_tiles, max_tiles, hold)

    def _prepare(
        self,
        number: int,
        planes: Planes,
        stamps: I8,
        geometry: Geometry,
        max_new_tiles: int | None,
        max_tiles: int | None,
        hold: Hold,
    ) -> Prepared:
        return prepare(
            number, planes, stamps, geometry, self._state, self._table, self.settings, self._space, max_new_tiles,
            max_tiles, hold,
        )  # fmt: skip

    def integrate(self, prepared: Prepared) -> AddReport:
        """Take up what was prepared last. MemoryError, or ValueError if the map has changed since: nothing is done."""
        work = prepared.work
        if work is None:
            return AddReport(0, prepared.rejected)
        if prepared.state != (*self._state, self._space.uses):
            raise ValueError("expected what was prepared last, for the map as it is now")
        newest_ns = integrate(work, self.sequence + 1, self._table, self.settings, self._space)
        self.sequence += 1
        self.newest_updated = max(self.newest_updated, newest_ns // 1_000_000_000)
        return AddReport(prepared.accepted, prepared.rejected, work.changed)

    @property
    def _state(self) -> tuple[int, int]:
        """Another one after each change of the map."""
        return self.sequence, self._cache.generation

    def reset(self) -> None:
        """Forget all cells; the sequence goes on. Readings that are open keep what they hold."""
        self._table.clear()
        self._table = TileTable(self.levels, self._table.shelf)
        self._cache.generation += 1
        self.newest_updated = 0
        self.sequence += 1

    def set_sequence(self, sequence: int) -> None:
        """At recovery, before any tile is loaded: the sequence that the stored tiles have. ValueError otherwise."""
        if self._table.size or sequence < 0:
            raise ValueError(f"sequence: expected one of at least 0 for an empty map, got {sequence}")
        self.sequence = sequence

    def load_tile(
        self, tx: int, ty: int, records: Records, oldest_ns: int, newest_ns: int, digest: bytes | None = None
    ) -> None:
        """Take a tile (4096,) of CELL_DTYPE from a store; its sequence becomes the map's as it is now.

        ``digest``: its XXH3-128 as 16 big-endian bytes if that is known. ValueError for a tile that is there already,
        has no known cell, or lies outside the map.
        """
        loading.load_tile(self._table, self.sequence, tx, ty, records, oldest_ns, newest_ns, digest)
        self._cache.generation += 1
        self.newest_updated = max(self.newest_updated, int(records["updated"].max()))

    def load_shelved(self, tx: I4, ty: I4, oldest_ns: I8, newest_ns: I8, digests: U1, places: I4) -> None:
        """Fill an empty map with (T,) different tiles that lie in allocated ``places`` of the shelf and stay there.

        ``digests`` (T, 16): as `load_tile`'s. The tiles' sequence becomes the map's. ValueError, and nothing is
        changed, for a map that is not empty, tiles outside it or twice, and stamps that are none. That each tile has a
        known cell is taken for granted.
        """
        loading.load_shelved(self._table, self.sequence, tx, ty, oldest_ns, newest_ns, digests, places)
        self._cache.generation += 1
        # The newest stamp of a tile is that of a point which touched one of its cells.
        self.newest_updated = int(newest_ns.max(initial=0)) // 1_000_000_000

    def spill(self, number: int) -> Eviction:
        """Begin to take about ``number`` tiles out of memory, those first that were not needed for the longest.

        Under the same lock as the map's other methods; `Eviction.write` then needs none, its `close` does again.
        """
        return Eviction(self._table, number)

    def limit_cache(self, limit: int) -> None:
        """Keep at most so many bytes of merged and read tiles for readers, if that is less than now."""
        self._cache.limit = min(self._cache.limit, limit)

    def tile_digests(self) -> tuple[I4, I4, U1]:
        """(tx, ty, digests (T, 16)) of the level-0 tiles with a known cell, ascending by (tx, ty)."""
        return self._table.digests()

    def digest(self) -> str:
        """XXH3-128, hex, over the digests of all tiles; of an empty map that of no bytes. Kept until it changes."""
        if self._digest[0] != self._state:
            self._digest = self._state, map_digest(*self.tile_digests())
        return self._digest[1]

    def freeze(self, level: int = 0, box: TileBox | None = None, *, after: int = -1) -> Frozen:
        """The tiles of ``level`` in ``box`` (inclusive tile numbers; None: all) as they are now, to be read later.

        ``after``: of level 0, only tiles whose sequence is larger; the others are not there then, not for their
        neighbours either.

        A context manager, to be closed under the same lock as the map's methods. ValueError for an unknown level.
        """
        self._check_level(level)
        return Frozen(
            self._table,
            self._cache,
            level=level,
            box=box,
            after=after,
            cell_size=self.cell_size,
            sequence=self.sequence,
            newest_updated=self.newest_updated,
        )

    def region(
        self,
        bbox: Sequence[float],
        layers: Sequence[str],
        level: int = 0,
        height_tolerance: float = 0.05,
        limits: Mapping[str, float] | None = None,
    ) -> Region:
        """Layers over the box (xmin, ymin, xmax, ymax) in metres, as `read_region` gives them."""
        self._check_level(level)
        tiles = tile_box(cell_box(bbox, self.cell_size * (1 << level)))
        with self.freeze(level, tiles) as frozen:
            return read_region(frozen, bbox, layers, height_tolerance, limits)

    def _check_level(self, level: int) -> None:
        if not isinstance(level, int | np.integer) or not 0 <= level < self.levels:
            raise ValueError(f"level: expected an integer in [0, {self.levels}), got {level!r}")

    def close(self) -> None:
        """End the threads; the map stays as it is."""
        self._space.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
