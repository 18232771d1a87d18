"""`RoughMapClient`: one map of one service, over Zenoh, as numpy arrays."""

import json
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
from roughmap_schemas import (
    CellsQuery,
    ConfigFault,
    ControlAnswer,
    ForgetQuery,
    Keys,
    MapStatus,
    Receipt,
    RegionQuery,
    TileQuery,
    encodings,
)
from roughmap_schemas.keys import NAME, NAME_WORDS

T = TypeVar("T")

Bbox = tuple[float, float, float, float]
InputKind = Literal["points", "odometry", "transform"]

RETRY_S = 0.1
MAX_RETRY_S = 2.0
"""A query without an answer, or refused as busy, is repeated: first after ``RETRY_S``, then after twice as long each
time, up to ``MAX_RETRY_S``."""

RECEIPT_S = 2.0
"""If no receipt comes within this time, the same bytes are sent again. That does no harm: the service recognises them
by their hash."""

RETRIABLE = frozenset({"busy", "shutting_down", "log_unavailable"})
"""Codes of errors that pass by themselves."""

INPUT_ENCODINGS: Mapping[str, str] = {
    "points": encodings.POINT_CLOUD,
    "odometry": encodings.ODOMETRY,
    "transform": encodings.FRAME_TRANSFORM,
}


class RoughMapClient:
    """A client of one map; a context manager, usable from several threads.

    ``connect`` are Zenoh endpoints of the service or of a router, such as ``tcp/127.0.0.1:7447``. Instead, you may pass
    a ``session`` of your own, which is left open at the end. ``config`` is a Zenoh configuration, or a file with one
    (JSON5): certificates, user and password, and endpoints if ``connect`` has none. ``timeout`` (s) bounds every call
    that has none of its own. Within it, queries without an answer are repeated, so a call waits for a service that
    restarts. Coordinates and heights are metres in the map's frame, angles radians, stamps nanoseconds since the Unix
    epoch.

    All errors are RoughMapError: BadArgument before anything is sent; NoAnswer if no answer came in time; QueryRefused
    with the service's code; IncompleteAnswer, MixedInstances and UnreadableAnswer for answers that must not be used;
    ContractMismatch for a service of another major version of the contract. The constructor raises BadArgument, and
    NoAnswer if no connection comes about within ``timeout``.
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
        """Close all watches, and the session if the client opened it."""
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
        """Return layers over ``bbox`` (xmin, ymin, xmax, ymax in metres), NaN in unknown cells.

        Each layer is (ny, nx) of ``dtype``, row 0 at the lowest y, over the cells of ``level`` (side: cell size times
        2^level) that the box covers. ``schemas/README.md`` lists the layers and their units. ``tolerance`` (m) is the
        full width of `confidence_level` (eq. 11), ``limits`` are those of `traversability`; None: the map's.
        QueryRefused: `bad_bbox`, `bad_level`, `unknown_layer`, `bad_parameter`, `too_large`.
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
        """Return the known tiles that meet ``bbox`` (metres, half-open; None: all), whole, of one state of the map.

        Tiles ascend by (x, y); layers are (64, 64) float32 as in `region`. An empty list means that the service has no
        such tile. QueryRefused: `bad_bbox`, `bad_level`, `unknown_layer`, `too_large`.
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
        """Return the tiles that changed since the ``version`` of an earlier answer; None: all tiles.

        If the service was restarted or the map reset since, ``complete`` is true and the tiles are the whole map, with
        `known_cells` 0 for tiles that a reset emptied. Use the same ``bbox`` and ``level`` as before. QueryRefused: as
        `tiles`.
        """

        def query(before: MapStatus) -> TileQuery:
            held = _held(since, before)
            return TileQuery(
                bbox=bbox, layers=tuple(layers), compression="zstd",
                since=None if held is None else held.sequence, epoch=None if held is None else held.epoch,
            )  # fmt: skip

        tiles, before = self._tiles_and_status(query, level, self._until(timeout))
        # An empty answer has no version; the status from before it is the latest that is certain.
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

        The service publishes the layers and levels in its ``updates`` settings. Callbacks come one by one in a thread
        of their own; while one runs, newer states of a tile replace older ones that wait. Exceptions of the callback
        are logged, and the watch goes on. Unreadable updates go to ``on_error``, or are logged without it. The watch
        goes on after a restart of the service, with another ``version.epoch``. Raises NoAnswer on a closed session.
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
        """Return the cells at places (N, 2) in metres, N at most 10,000, in the order of the places.

        ``tolerance`` and ``limits`` as in `region`. BadArgument for another shape; QueryRefused: `too_large`,
        `bad_parameter` (places that are not finite or beyond int32 cells), `unknown_layer`.
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
        """Return the status of the service and its map."""
        return self._status(self._until(timeout))

    def ingest(
        self, message: bytes, robot: str, *, kind: InputKind = "points", timeout: float | None = None
    ) -> Receipt:
        """Send a cloud, pose or transform and return its receipt: the message is in the log, on the disk.

        ``message`` is a serialised foxglove.PointCloud, Odometry or FrameTransform. While no receipt comes or the
        service is busy, the same bytes are sent again, until the time limit; the service takes them once.
        QueryRefused: `bad_message`, `too_large`, `unknown_sensor`, `unknown_robot`, `busy`, `log_unavailable`,
        `shutting_down`. After NoAnswer the message may or may not be logged: send the same bytes again.
        """
        if kind not in INPUT_ENCODINGS:
            raise BadArgument(f"kind: expected one of {', '.join(INPUT_ENCODINGS)}; found {kind!r}")
        if not NAME.fullmatch(robot):
            raise BadArgument(f"robot: expected {NAME_WORDS}; found {robot[:80]!r}")
        part = self._ask(
            self._keys.form(f"ingest_{kind}").make(robot=robot), "", self._until(timeout), Answer.single,
            payload=message, encoding=INPUT_ENCODINGS[kind], attempt=RECEIPT_S,
        )  # fmt: skip
        return read_model(part, Receipt)

    def forget(
        self, bbox: Bbox | None = None, older: float | None = None, *, timeout: float | None = None
    ) -> ControlAnswer:
        """Erase level-0 tiles of the map, and return how many: the ground there is unknown until it is seen again.

        Tiles that meet ``bbox`` (xmin, ymin, xmax, ymax in metres), whole; tiles without a point in the last ``older``
        seconds, by the stamps of the points; with both, tiles that are both. For operators: where roles are set, others
        may not. QueryRefused: `bad_bbox`, `bad_parameter` (neither is given), `log_unavailable`, `shutting_down`.
        """
        asked = ForgetQuery(bbox=bbox, older=older)
        part = self._ask(self._keys.control("forget"), asked.format(), self._until(timeout), Answer.single)
        return read_model(part, ControlAnswer)

    def _until(self, timeout: float | None) -> float:
        """Return the end of a call on the monotonic clock."""
        return time.monotonic() + (self._timeout if timeout is None else timeout)

    def _status(self, until: float) -> MapStatus:
        return read_model(self._ask(self._keys.status, "", until, Answer.single), MapStatus)

    def _tiles(self, asked: TileQuery, level: int, until: float) -> list[Tile]:
        """Return the tiles of one answer; none if there is no such tile or no service."""
        return read_tiles(self._ask(self._keys.tiles(level), asked.format(), until, Answer.whole), asked.layers)

    def _tiles_and_status(
        self, query: Callable[[MapStatus], TileQuery], level: int, until: float
    ) -> tuple[list[Tile], MapStatus]:
        """Return tiles and the status right before them, of one instance, so that an empty answer is the service's."""
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
        """Repeat a query until ``take`` accepts its answer; at the time limit, raise its last error.

        The last refusal tells more than that no answer came in what was left of the time.
        """
        selector = f"{key}?{parameters}" if parameters else key
        pause, last = RETRY_S, None
        while True:
            left = max(until - time.monotonic(), 0.001)
            try:
                answer = ask(
                    self._session, selector, timeout=min(left, attempt), payload=payload, encoding=encoding,
                    single=take is Answer.single,
                )  # fmt: skip
                return take(answer)
            except QueryRefused as refused:
                if refused.code not in RETRIABLE or time.monotonic() + RETRY_S >= until:
                    raise
                last = refused
            except NoAnswer as error:
                if self._session.is_closed():
                    raise
                if time.monotonic() + RETRY_S >= until:
                    raise last or error from None
            # At most half of the time left, so that the last attempt comes near the limit.
            time.sleep(min(pause, max((until - time.monotonic()) / 2, RETRY_S)))
            pause = min(2 * pause, MAX_RETRY_S)


def _held(since: Version | None, status: MapStatus) -> Version | None:
    """Return the version if it is in this run's past, None if all tiles must be queried."""
    if since is None or (since.epoch, since.sequence) > (status.epoch, status.sequence):
        return None
    if since.epoch == status.epoch and since.instance not in {"", status.instance}:
        return None
    return since
