"""The map: points in, tiles of cells kept up to date, layers out."""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from types import TracebackType
from typing import Self

import numba
import numpy as np
import numpy.typing as npt

from roughmap.arrays import I4, I8, U1
from roughmap.cell import TILE_CELLS
from roughmap.integration.geometry import PointInput, Shared, placed_points, scan_points
from roughmap.integration.phases import AddReport, Prepared, phase_one, phase_two
from roughmap.integration.workspace import Workspace
from roughmap.points.scan import Limits, Noise, Scan
from roughmap.points.trajectory import Trajectory
from roughmap.reading.frozen import FrozenMap
from roughmap.reading.merge_cache import MergeCache
from roughmap.reading.region import Region, cell_box, read_region, tile_box
from roughmap.settings import MapSettings
from roughmap.tiles import loading
from roughmap.tiles.changes import rings
from roughmap.tiles.digest import map_digest
from roughmap.tiles.eviction import Eviction
from roughmap.tiles.index import TileBox, TileVersions, paired
from roughmap.tiles.shelf import Shelf
from roughmap.tiles.state import TileState
from roughmap.tiles.table import ReaderLock, TileTable

_SECOND_NS = 1_000_000_000


class RoughMap:
    """A rough-ground map of any extent, built point by point.

    ``cell_size``: metres. ``error_model``: "point", "cuboid" or "ellipsoid". ``coverage``: half extent of the error
    body in sigmas. ``min_radius``: smallest half extent, metres. ``min_distance``: smallest distance in eq. 16, metres.
    ``surface``: with "ground", cells hold the ground alone, and columns hold what is above and below it; with "all",
    cells hold every point. ``min_share``: a cell counts if its share is at least this fraction of the point's largest
    share. ``max_horizontal_radius`` (half extent) and ``max_vertical_sigma`` (standard deviation): metres, beyond which
    a point is too uncertain. ``bounds``: (xmin, ymin, xmax, ymax) metres, half-open. ``levels``: number of levels,
    level 0 included. ``threads``: threads that share the work (None: numba's number). ``shelf``: storage for the tiles
    that `spill` moves out of memory.

    The same points, covariances and stamps in the same order give the same bytes of state, for any division into calls
    and any number of threads.

    Only one thread at a time may call the methods, with two exceptions: while other threads call `freeze`, the thread
    that changes the map may call `digest`, and `prepare_points` and `prepare_scan` as described there. A frozen map may
    be read by any thread at any time. Invalid arguments raise ValueError and change nothing.
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
        max_vertical_sigma: float = 0.5,
        surface: str = "ground",
        shelf: Shelf | None = None,
    ) -> None:
        self.settings = MapSettings(
            cell_size=cell_size, error_model=error_model, coverage=coverage, min_radius=min_radius,
            min_distance=min_distance, min_share=min_share, max_horizontal_radius=max_horizontal_radius,
            max_vertical_sigma=max_vertical_sigma, bounds=bounds, levels=levels, surface=surface,
        )  # fmt: skip
        threads = numba.config.NUMBA_NUM_THREADS if threads is None else threads  # type: ignore[attr-defined]
        if not isinstance(threads, int) or not 1 <= threads <= 256:
            raise ValueError(f"threads: expected an integer in [1, 256] or None, got {threads!r}")
        self.sequence = 0
        """Increases by 1 with each call that accepts a point, each `reset`, and each `forget` of a tile."""
        self.forgotten_at = 0
        """The sequence of the last `forget`; 0 if there was none."""
        self.newest_updated = 0
        """The newest stamp of any tile, in whole seconds; 0 if the map is empty."""
        self._space = Workspace(threads, self.settings.side)
        self._rings = rings(self.settings.surface, self.settings.cell_size, levels)
        self._table = TileTable(self._rings, shelf or Shelf())
        self._cache = MergeCache()

    @property
    def cell_size(self) -> float:
        """Side of a level-0 cell, metres."""
        return self.settings.cell_size

    @property
    def levels(self) -> int:
        """Number of levels, level 0 included."""
        return self.settings.levels

    @property
    def tile_count(self) -> int:
        """Number of level-0 tiles with a known cell."""
        return self._table.size

    @property
    def resident_tiles(self) -> int:
        """Number of these tiles that are in memory; the others are on the shelf."""
        return self._table.resident

    @property
    def memory_bytes(self) -> int:
        """Bytes of tiles (counted whole), tables and merged levels; the resident memory may be less."""
        return self._table.nbytes + self._cache.nbytes

    def tile_sequences(self, level: int = 0, box: TileBox | None = None) -> tuple[I4, I8]:
        """Return the (T, 2) tiles of a level in ``box`` (None: all), ascending by (x, y), and their (T,) sequences."""
        tx, ty, sequence = self._table.levels[level].select(box)
        return paired(tx, ty), sequence

    def changed_tiles(self, level: int, after: int) -> tuple[I4, I8]:
        """Return the same for the tiles whose sequence is larger than ``after``."""
        index = self._table.levels[level]
        entries = index.changed(after)
        return paired(index.tx[entries], index.ty[entries]), index.sequence[entries]

    def tile_stamps(self) -> tuple[I4, I8]:
        """Return the (T, 2) level-0 tiles, ascending by (x, y), and the (T,) newest stamp of each, in ns."""
        base = self._table.levels[0]
        entries = base.entries(None)
        return paired(base.tx[entries], base.ty[entries]), self._table.newest_ns[entries]

    def tile_versions(self) -> list[TileVersions]:
        """Return the current tiles and sequences of each level, to be read while the map changes."""
        return [level.versions() for level in self._table.levels]

    def extent(self) -> tuple[float, float, float, float] | None:
        """Return xmin, ymin, xmax, ymax in metres of the tiles with a known cell; None if the map is empty."""
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
        common: npt.ArrayLike | None = None,
        mount: npt.ArrayLike | None = None,
        up: npt.ArrayLike | None = None,
        pose_error_time: float = 5.0,
        offsets_ns: npt.ArrayLike | None = None,
        max_new_tiles: int | None = None,
        max_tiles: int | None = None,
    ) -> AddReport:
        """Add points (N, 3) in the map frame, in metres.

        ``covariance``: (N, 3, 3), or (3, 3) for all points, in square metres and map axes; only the upper triangle is
        used. Required unless the model is "point", which ignores it. ``stamp_ns``: one integer or (N,), in [0, 2^32 s).
        ``offsets_ns`` (N,): added to the stamps; a point with an offset below 0 or above 1 s is rejected as `time`.
        ``common``, ``mount``: the parts of the heights' variances that come from the poses and from the mounting, one
        number or (N,), in square metres (None: 0); negative ones count as 0. ``pose_error_time``: seconds over which
        errors of the poses stay alike. ``up``, one or (N,): whether a point's beam rose too steeply to end on the
        ground (None: no). `georeference` returns ``common``, ``mount`` and ``up``.
        `TooManyTiles`, with no cell written, if the call would create more than ``max_new_tiles`` tiles or the map
        would have more than ``max_tiles``.
        """
        prepared = self.prepare_points(
            points, covariance, stamp_ns, common=common, mount=mount, up=up, pose_error_time=pose_error_time,
            offsets_ns=offsets_ns, max_new_tiles=max_new_tiles, max_tiles=max_tiles,
        )  # fmt: skip
        return self.integrate(prepared)

    def add_scan(
        self,
        scan: Scan,
        trajectory: Trajectory,
        noise: Noise,
        limits: Limits | None = None,
        *,
        clear: bool = False,
        max_new_tiles: int | None = None,
        max_tiles: int | None = None,
    ) -> AddReport:
        """Place a scan (eq. 1) and add its points. The result equals `georeference` followed by `add`, to the bit.

        The points are processed in blocks, without an array of all covariances. ``clear``: then halve the hits off the
        ground, near the sensor, that the scan saw through. With the surface "all" it does nothing. Each scan halves
        again: a scan every 0.2 s is enough. ``max_new_tiles``, ``max_tiles``: as in `add`.
        """
        prepared = self.prepare_scan(
            scan, trajectory, noise, limits, clear=clear, max_new_tiles=max_new_tiles, max_tiles=max_tiles
        )
        return self.integrate(prepared)

    def prepare_points(
        self,
        points: npt.ArrayLike,
        covariance: npt.ArrayLike | None = None,
        stamp_ns: npt.ArrayLike = 0,
        *,
        common: npt.ArrayLike | None = None,
        mount: npt.ArrayLike | None = None,
        up: npt.ArrayLike | None = None,
        pose_error_time: float = 5.0,
        offsets_ns: npt.ArrayLike | None = None,
        max_new_tiles: int | None = None,
        max_tiles: int | None = None,
        reader_lock: ReaderLock = nullcontext,
    ) -> Prepared:
        """Do the part of an `add` that readers cannot see: compute footprints, and bring the tiles into memory.

        The thread that changes the map may call it without the lock under which others call `freeze`. ``reader_lock``
        takes that lock for moments; it is not held while tiles are read from the shelf. An error leaves the map as it
        was. Call `integrate` next, under the lock.
        """
        shared = Shared(common, mount, up, pose_error_time)
        given = placed_points(points, covariance, stamp_ns, offsets_ns, shared, self.settings, self._space)
        return self._prepare(given, max_new_tiles, max_tiles, reader_lock)

    def prepare_scan(
        self,
        scan: Scan,
        trajectory: Trajectory,
        noise: Noise,
        limits: Limits | None = None,
        *,
        clear: bool = False,
        max_new_tiles: int | None = None,
        max_tiles: int | None = None,
        reader_lock: ReaderLock = nullcontext,
    ) -> Prepared:
        """Do the same for an `add_scan`."""
        given = scan_points(scan, trajectory, noise, limits or Limits(), clear, self.settings, self._space)
        return self._prepare(given, max_new_tiles, max_tiles, reader_lock)

    def _prepare(
        self, points: PointInput, max_new_tiles: int | None, max_tiles: int | None, reader_lock: ReaderLock
    ) -> Prepared:
        return phase_one(
            points, self._version, self._table, self.settings, self._space, max_new_tiles, max_tiles, reader_lock
        )

    def integrate(self, prepared: Prepared) -> AddReport:
        """Add the points that were prepared last.

        ValueError if the map has changed since, or MemoryError; the map is then as it was. RuntimeError if memory ran
        out halfway: then the map is of no more use.
        """
        work = prepared.work
        if work is None:
            return AddReport(0, prepared.rejected)
        if prepared.version != (*self._version, self._space.uses):
            raise ValueError("expected the points prepared last, for the map as it is now")
        newest_ns, cleared, changed = phase_two(work, self.sequence + 1, self._table, self.settings, self._space)
        self.sequence += 1
        self.newest_updated = max(self.newest_updated, newest_ns // _SECOND_NS)
        return AddReport(prepared.accepted, prepared.rejected, changed, cleared)

    @property
    def _version(self) -> tuple[int, int]:
        """Differs after each change of the map."""
        return self.sequence, self._cache.generation

    def reset(self) -> None:
        """Remove all cells; the sequence goes on. Open frozen maps keep their cells."""
        self._table.clear()
        self._table = TileTable(self._rings, self._table.shelf)
        self._cache.generation += 1
        self.newest_updated = 0
        self.sequence += 1

    def set_sequence(self, sequence: int) -> None:
        """Set the sequence that stored tiles have. ValueError unless the map is empty and ``sequence`` >= 0."""
        if self._table.size or sequence < 0:
            raise ValueError(
                f"sequence: expected at least 0 for an empty map, got {sequence} for {self.tile_count} tiles"
            )
        self.sequence = sequence

    def forget(self, tiles: npt.ArrayLike) -> int:
        """Remove level-0 tiles, given as (T, 2) tile numbers, and return how many of them the map had.

        If it had any, the map's sequence increases by 1, and the tiles around and above them get it. Open frozen maps
        keep their cells. ValueError for anything but (T, 2) integers.
        """
        entries = self._table.levels[0].find_present(tiles)
        if not len(entries):
            return 0
        self._table.forget(entries, self.sequence + 1)
        self.sequence += 1
        self.forgotten_at = self.sequence
        self.newest_updated = self._newest()
        return len(entries)

    def _newest(self) -> int:
        """Return the newest second of the tiles, 0 if there are none."""
        return int(self._table.newest_ns[: self.tile_count].max(initial=0)) // _SECOND_NS

    def load_tile(
        self, tx: int, ty: int, state: TileState, oldest_ns: int, newest_ns: int, digest: bytes | None = None
    ) -> None:
        """Load a stored tile. Its sequence becomes the current one of the map.

        ``digest``: its XXH3-128 as 16 big-endian bytes, if known. ValueError for a tile that the map already has, that
        has no known cell, whose column has no based cell, or that lies outside the map.
        """
        loading.load_tile(self._table, self.sequence, tx, ty, state, oldest_ns, newest_ns, digest)
        self._cache.generation += 1
        self.newest_updated = max(self.newest_updated, newest_ns // _SECOND_NS)

    def load_shelved(self, tx: I4, ty: I4, oldest_ns: I8, newest_ns: I8, digests: U1, places: I4) -> None:
        """Fill an empty map with (T,) different tiles that lie in allocated ``places`` of the shelf and stay there.

        ``digests`` (T, 16): as in `load_tile`. The sequence of the tiles becomes the current one of the map.
        ValueError, with nothing changed, if the map is not empty, a tile lies outside the map or appears twice, or a
        stamp is invalid. Whether each tile has a known cell is not checked.
        """
        loading.load_shelved(self._table, self.sequence, tx, ty, oldest_ns, newest_ns, digests, places)
        self._cache.generation += 1
        self.newest_updated = self._newest()

    def spill(self, number: int) -> Eviction:
        """Start to move about ``number`` tiles, the least recently used ones, to the shelf.

        Call it under the lock of the map's other methods, then `Eviction.write` without it and `Eviction.close` under
        it.
        """
        return Eviction(self._table, number)

    def limit_cache(self, limit: int) -> None:
        """Lower the limit on the bytes of merged and read tiles cached for readers to ``limit``, if it is higher."""
        self._cache.limit = min(self._cache.limit, limit)

    def tile_digests(self) -> tuple[I4, I4, U1]:
        """Return (tx, ty, digests (T, 16)) of the level-0 tiles with a known cell, ascending by (tx, ty)."""
        return self._table.tile_digests()

    def digest(self) -> str:
        """Return the XXH3-128 of the map, in hex; see `map_digest`. It costs what has changed since the last call."""
        self._table.refresh_digests()
        return map_digest(self.tile_count, self._table.digests.total)

    def freeze(self, level: int = 0, box: TileBox | None = None, *, after: int = -1) -> FrozenMap:
        """Freeze the tiles of ``level`` in ``box`` (tile numbers, inclusive; None: all) as they are now, to be read
        later.

        ``after``: only level-0 tiles with a larger sequence; the others count as unknown, as neighbours too.

        Returns a context manager, to be closed under the lock of the map's methods. ValueError for an unknown level.
        """
        self._check_level(level)
        return FrozenMap(
            self._table, self._cache, surface=self.settings.surface, level=level, box=box, after=after,
            cell_size=self.cell_size, sequence=self.sequence, newest_updated=self.newest_updated,
        )  # fmt: skip

    def region(
        self,
        bbox: Sequence[float],
        layers: Sequence[str],
        level: int = 0,
        height_tolerance: float = 0.05,
        limits: Mapping[str, float] | None = None,
    ) -> Region:
        """Return layers over the box (xmin, ymin, xmax, ymax) in metres; see `read_region`."""
        self._check_level(level)
        tiles = tile_box(cell_box(bbox, self.cell_size * (1 << level)))
        with self.freeze(level, tiles) as frozen:
            return read_region(frozen, bbox, layers, height_tolerance, limits)

    def _check_level(self, level: int) -> None:
        if not isinstance(level, int | np.integer) or not 0 <= level < self.levels:
            raise ValueError(f"level: expected an integer in [0, {self.levels}), got {level!r}")

    def close(self) -> None:
        """End the threads. The map stays usable."""
        self._space.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
