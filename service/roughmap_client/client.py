"""What a planner imports: one map of one service, asked over Zenoh, as numpy arrays."""

import json
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Literal, Self, TypeVar

import numpy as np
import numpy.typing as npt
import zenoh

from roughmap_client.errors import BadArgument, NoAnswer, QueryRefused, RoughMapError
from roughmap_client.replies import read_cells, read_model, read_region, read_tiles, read_update
from roughmap_client.results import Cells, Changes, Region, Tile, Version
from roughmap_client.session import Answer, ask, open_session
from roughmap_client.watching import Watch
from roughmap_schemas import CellsQuery, ConfigFault, Keys, MapStatus, Receipt, RegionQuery, TileQuery, encodings
from roughmap_schemas.keys import NAME, NAME_WORDS

T = TypeVar("T")

Bbox = tuple[float, float, float, float]
InputKind = Literal["points", "odometry", "transform"]

AGAIN_S = 0.1
AGAIN_MOST_S = 2.0
"""Where nobody answers, or the service is too busy, the question is asked again: first after the one, and after twice
as long each time, up to the other."""

RECEIPT_S = 2.0
"""A receipt that did not come after so long is not waited for any more: the same bytes are sent again, which does no
harm, since the service knows them by their hash."""

PASSING = frozenset({"busy", "shutting_down", "log_unavailable"})
"""Refusals that may be gone when the same is asked again."""

INPUT_ENCODINGS: Mapping[str, str] = {
    "points": encodings.POINT_CLOUD,
    "odometry": encodings.ODOMETRY,
    "transform": encodings.FRAME_TRANSFORM,
}


class RoughMapClient:
    """One map's reader and feeder; a context manager, usable from several threads.

    ``connect`` are Zenoh endpoints of the service or of a router, such as ``tcp/127.0.0.1:7447``; or give a ``session``
    of your own, which is then left open at the end. ``config`` is a Zenoh configuration, or its file (JSON5), with
    certificates, user and password, and endpoints where ``connect`` gives none. ``timeout`` (s) bounds every call, and
    so does each call's own: within it a question is asked again while nobody answers, so that a service that restarts
    meanwhile is waited for. Coordinates and heights are metres in the map's frame, angles radians, stamps nanoseconds
    since the Unix epoch.

    All errors are RoughMapError: BadArgument before anything is asked; NoAnswer if none came within the time limit;
    QueryRefused with the service's code; IncompleteAnswer, MixedInstances and UnreadableAnswer for answers that must
    not be used. The constructor raises BadArgument, and NoAnswer if no connection comes about within ``timeout``.
    """

    def __init__(
        self,
        map_name: str,
        connect: str | Sequence[str] = (),
        *,
        timeout: float = 10.0,
        session: zenoh.Session | None = None,
        config: zenoh.Config | str | Path | None = None,
        keys: Mapping[str, str] | None = None,
    ) -> None:
        try:
            self._keys = Keys(map_name, keys)
        except ConfigFault as fault:
            raise BadArgument(str(fault)) from None
        self._timeout = timeout
        self._owned = session is None
        self._watches: weakref.WeakSet[Watch] = weakref.WeakSet()
        endpoints = [connect] if isinstance(connect, str) else list(connect)
        self._session = open_session(endpoints, timeout, config) if session is None else session

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End its watches, and close the session if it is the client's own."""
        for watch in list(self._watches):
            watch.close()
        if self._owned and not self._session.is_closed():
            self._session.close()

    def region(
        self,
        bbox: Bbox,
        layers: Iterable[str] = ("mean_height",),
        *,
        level: int = 0,
        tolerance: float | None = None,
        limits: Mapping[str, float] | None = None,
        dtype: Literal["f4", "f8"] = "f4",
        timeout: float | None = None,
    ) -> Region:
        """Layers over ``bbox`` (xmin, ymin, xmax, ymax in metres) as one mosaic, NaN where nothing is known.

        Each layer is (ny, nx) of ``dtype``, row 0 at the lowest y, over the cells of ``level`` (side: cell size times
        2^level) that the box covers, in the map's units (metres, radians; see the contract's table of layers).
        ``tolerance`` (m) is the full width of `confidence_level` (eq. 11), ``limits`` are `traversability`'s; None: the
        map's. QueryRefused: `bad_bbox`, `bad_level`, `unknown_layer`, `bad_parameter`, `too_large`.
        """
        asked = RegionQuery(
            bbox=bbox, layers=tuple(layers), level=level, tolerance=tolerance, limits=limits, dtype=dtype,
            compression="zstd",
        )  # fmt: skip
        answer = self._ask(self._keys.region, asked.format(), self._until(timeout), Answer.single)
        return read_region(answer, asked.layers)

    def tiles(
        self,
        bbox: Bbox | None = None,
        layers: Iterable[str] = ("mean_height",),
        *,
        level: int = 0,
        timeout: float | None = None,
    ) -> list[Tile]:
        """The known tiles that meet ``bbox`` (metres, half-open; None: all), each whole, all of one state of the map.

        Ascending by (x, y); layers are (64, 64) float32 as in `region`. An empty list says that a service is there and
        knows no such tile. QueryRefused: `bad_bbox`, `bad_level`, `unknown_layer`, `too_large`.
        """
        asked = TileQuery(bbox=bbox, layers=tuple(layers), compression="zstd")
        until = self._until(timeout)
        return self._tiles(asked, level, until) or self._tiles_and_status(lambda _: asked, level, until)[0]

    def changes(
        self,
        since: Version | None = None,
        layers: Iterable[str] = ("mean_height",),
        *,
        bbox: Bbox | None = None,
        level: int = 0,
        timeout: float | None = None,
    ) -> Changes:
        """The tiles that changed since a version, of an earlier answer's ``version``; None: all tiles.

        If the map was restarted or reset since, ``anew`` is true and the tiles are all there are, those that a reset
        emptied with `known_cells` 0. Ask with the same ``bbox`` and ``level`` as before. QueryRefused as `tiles`.
        """

        def query(before: MapStatus) -> TileQuery:
            held = _held(since, before)
            return TileQuery(
                bbox=bbox, layers=tuple(layers), compression="zstd",
                since=None if held is None else held.sequence, epoch=None if held is None else held.epoch,
            )  # fmt: skip

        tiles, before = self._tiles_and_status(query, level, self._until(timeout))
        # Without a tile the answer tells no version; what was true before it is the latest that is known for sure.
        version = tiles[0].version if tiles else Version(before.epoch, before.sequence, before.instance)
        held = _held(since, before)
        return Changes(version, tiles, complete=held is None or held.epoch != version.epoch)

    def watch(
        self,
        callback: Callable[[Tile], None],
        *,
        level: int = 0,
        on_error: Callable[[RoughMapError], None] | None = None,
    ) -> Watch:
        """Call ``callback`` with each tile of a level as it changes, until the watch is closed (a context manager).

        The service publishes the layers and levels of its ``updates`` settings. Tiles come one by one in a thread of
        their own; while the callback is busy, a newer state of a tile takes the place of an older one that waits. What
        the callback raises is logged, and the watch goes on. ``on_error`` is told of updates that can't be read (they
        are logged otherwise). The watch outlives a restart of the service; a tile's ``version`` tells of it.
        NoAnswer if the session is closed.
        """
        key = self._keys.form("updates").make(z=level, x="*", y="*")
        watch = Watch(self._session, key, read_update, callback, on_error)
        self._watches.add(watch)
        return watch

    def cells(
        self,
        points: npt.ArrayLike,
        layers: Iterable[str] = ("mean_height",),
        *,
        tolerance: float | None = None,
        limits: Mapping[str, float] | None = None,
        timeout: float | None = None,
    ) -> Cells:
        """The cells in which places (N, 2) in metres fall, N at most 10,000, in the order of the places.

        ``tolerance`` and ``limits`` as in `region`. BadArgument for another shape; QueryRefused: `too_large`,
        `bad_parameter` (places that are not finite, or whose cells' numbers are not int32), `unknown_layer`.
        """
        try:
            places = np.asarray(points, np.float64)
        except (TypeError, ValueError) as error:
            raise BadArgument(f"points: expected numbers of shape (N, 2); {error}") from None
        if places.shape != (2,) and (places.ndim != 2 or places.shape[1] != 2):
            raise BadArgument(f"points: expected numbers of shape (N, 2); found {places.shape}")
        places = places.reshape(-1, 2)
        asked = CellsQuery(layers=tuple(layers), tolerance=tolerance, limits=limits)
        payload = json.dumps(places.tolist()).encode()
        until = self._until(timeout)
        answer = self._ask(self._keys.cells, asked.format()[0], until, Answer.single, payload=payload)
        return read_cells(answer, asked.layers, len(places))

    def status(self, *, timeout: float | None = None) -> MapStatus:
        """How the service and its map are."""
        return self._status(self._until(timeout))

    def ingest(
        self, message: bytes, robot: str, *, kind: InputKind = "points", timeout: float | None = None
    ) -> Receipt:
        """Hand in a cloud (or pose, or transform) as encoded; its receipt says that the log holds it, on the disk.

        ``message`` is a serialised foxglove.PointCloud (Odometry, FrameTransform). Where no receipt comes, or the
        service is busy, the same bytes are sent again, until the time limit; the service takes them once.
        QueryRefused: `bad_message`, `too_large`, `unknown_sensor`, `unknown_robot`, `busy`, `log_unavailable`,
        `shutting_down`. After NoAnswer the message may or may not be logged: send the same bytes again.
        """
        if kind not in INPUT_ENCODINGS:
            raise BadArgument(f"kind: expected one of {', '.join(INPUT_ENCODINGS)}; found {kind!r}")
        if not NAME.fullmatch(robot):
            raise BadArgument(f"robot: expected a name of {NAME_WORDS}; found {robot[:80]!r}")
        part = self._ask(
            self._keys.form(f"ingest_{kind}").make(robot=robot), "", self._until(timeout), Answer.single,
            payload=message, encoding=INPUT_ENCODINGS[kind], attempt=RECEIPT_S,
        )  # fmt: skip
        return read_model(part, Receipt)

    def _until(self, timeout: float | None) -> float:
        """The end of a call, on the monotonic clock."""
        return time.monotonic() + (self._timeout if timeout is None else timeout)

    def _status(self, until: float) -> MapStatus:
        return read_model(self._ask(self._keys.status, "", until, Answer.single), MapStatus)

    def _tiles(self, asked: TileQuery, level: int, until: float) -> list[Tile]:
        """One answer; none if there is no such tile, or nobody to answer."""
        return read_tiles(self._ask(self._keys.tiles(level), asked.format(), until, Answer.whole), asked.layers)

    def _tiles_and_status(
        self, query: Callable[[MapStatus], TileQuery], level: int, until: float
    ) -> tuple[list[Tile], MapStatus]:
        """Tiles and the status right before, of one instance: so an empty answer is the service's and no silence."""
        while True:
            before = self._status(until)
            tiles = self._tiles(query(before), level, until)
            after = tiles[0].info.instance if tiles else self._status(until).instance
            if after == before.instance:
                return tiles, before

    def _ask(
        self,
        key: str,
        parameters: str,
        until: float,
        take: Callable[[Answer], T],
        *,
        payload: bytes | None = None,
        encoding: str | None = None,
        attempt: float = float("inf"),
    ) -> T:
        """Ask until ``take`` accepts an answer, or the time limit comes: then its last error is raised."""
        selector = f"{key}?{parameters}" if parameters else key
        pause, nobody = AGAIN_S, threading.Event()
        while True:
            left = max(until - time.monotonic(), 0.001)
            try:
                answer = ask(
                    self._session, selector, timeout=min(left, attempt), payload=payload, encoding=encoding,
                    single=take is Answer.single,
                )  # fmt: skip
                return take(answer)
            except QueryRefused as refused:
                if refused.code not in PASSING or time.monotonic() + AGAIN_S >= until:
                    raise
            except NoAnswer:
                if self._session.is_closed() or time.monotonic() + AGAIN_S >= until:
                    raise
            # Half of what is left at most, so that the last time comes near the limit.
            nobody.wait(min(pause, max((until - time.monotonic()) / 2, AGAIN_S)))
            pause = min(2 * pause, AGAIN_MOST_S)


def _held(since: Version | None, status: MapStatus) -> Version | None:
    """The version if it is one of this run's past; None if all tiles must be asked for."""
    if since is None or (since.epoch, since.sequence) > (status.epoch, status.sequence):
        return None
    if since.epoch == status.epoch and since.instance not in {"", status.instance}:
        return None
    return since
