"""What a planner imports: one map of one service, asked over Zenoh, as numpy arrays."""

import json
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import TracebackType
from typing import Literal, Self, TypeVar

import numpy as np
import numpy.typing as npt
import zenoh

from roughmap_client.answers import Cells, Changes, Region, Tile, Version
from roughmap_client.asking import Answer, Part, ask
from roughmap_client.errors import NoAnswer, QueryRefused, RoughMapError
from roughmap_client.reading import read_cells, read_model, read_region, read_tiles, read_update
from roughmap_client.watching import Watch
from roughmap_schemas import (
    CellsQuery,
    Keys,
    MapStatus,
    Receipt,
    RegionQuery,
    TileQuery,
    encodings,
)

T = TypeVar("T")

Bbox = tuple[float, float, float, float]
InputKind = Literal["points", "odometry", "transform"]

AGAIN_S = 0.2
"""Where nobody answers, or the service is too busy, the question is asked again after so long."""

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
    of your own, which is then left open at the end. ``timeout`` (s) bounds every call: within it a question is asked
    again while nobody answers, so that a service that restarts meanwhile is waited for. All errors are RoughMapError.
    """

    def __init__(
        self,
        map_name: str,
        connect: Sequence[str] = (),
        *,
        timeout: float = 10.0,
        session: zenoh.Session | None = None,
        keys: Mapping[str, str] | None = None,
    ) -> None:
        self._keys = Keys(map_name, keys)
        self._timeout = timeout
        self._owned = session is None
        self._session = _open(connect, timeout) if session is None else session

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the session, if it is the client's own."""
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

        ``tolerance`` (m) is the full width of `confidence_level`, ``limits`` are `traversability`'s; None: the map's.
        """
        asked = RegionQuery(
            bbox=bbox, layers=tuple(layers), level=level, tolerance=tolerance, limits=limits, dtype=dtype,
            compression="zstd",
        )  # fmt: skip
        answer = self._ask(self._keys.region, asked.format(), timeout, Answer.single)
        return read_region(answer, asked.layers)

    def tiles(
        self,
        bbox: Bbox | None = None,
        layers: Iterable[str] = ("mean_height",),
        *,
        level: int = 0,
        timeout: float | None = None,
    ) -> list[Tile]:
        """The known tiles that meet ``bbox`` (None: all), each whole, all of one state of the map."""
        asked = TileQuery(bbox=bbox, layers=tuple(layers), compression="zstd")
        return self._tiles(asked, level, timeout)

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

        If the map was restarted or reset since, ``anew`` is true and the tiles are all there are.
        """
        status = self.status(timeout=timeout)
        before = Version(status.epoch, status.sequence)
        held = since if since is not None and since <= before else None
        asked = TileQuery(
            bbox=bbox, layers=tuple(layers), compression="zstd",
            since=None if held is None else held.sequence, epoch=None if held is None else held.epoch,
        )  # fmt: skip
        tiles = self._tiles(asked, level, timeout)
        # Without a tile the answer tells no version; what was true before it is the latest that is known for sure.
        version = tiles[0].version if tiles else before
        return Changes(version, tiles, anew=held is None or held.epoch != version.epoch)

    def watch(
        self,
        callback: Callable[[Tile], None],
        *,
        level: int = 0,
        on_error: Callable[[RoughMapError], None] | None = None,
    ) -> Watch:
        """Call ``callback`` with each tile of a level as it changes, until the watch is closed (a context manager).

        The service publishes the layers and levels of its ``updates`` settings. Tiles come one by one in a thread of
        their own; while the callback is busy, a newer state of a tile takes the place of an older one that waits.
        """
        key = self._keys.form("updates").make(z=level, x="*", y="*")
        return Watch(self._session, key, read_update, callback, on_error)

    def cells(
        self,
        points: npt.ArrayLike,
        layers: Iterable[str] = ("mean_height",),
        *,
        tolerance: float | None = None,
        limits: Mapping[str, float] | None = None,
        timeout: float | None = None,
    ) -> Cells:
        """The cells in which places (N, 2) in metres fall, N at most 10,000, in the order of the places."""
        places = np.asarray(points, np.float64).reshape(-1, 2)
        asked = CellsQuery(layers=tuple(layers), tolerance=tolerance, limits=limits)
        answer = self._ask(
            self._keys.cells, asked.format()[0], timeout, Answer.single, payload=json.dumps(places.tolist()).encode()
        )
        return read_cells(answer, asked.layers)

    def status(self, *, timeout: float | None = None) -> MapStatus:
        """How the service and its map are."""
        part = self._ask(self._keys.status, "", timeout, Answer.single)
        return read_model(part, MapStatus)

    def ingest(
        self, message: bytes, robot: str, *, kind: InputKind = "points", timeout: float | None = None
    ) -> Receipt:
        """Hand in a cloud (or pose, or transform) as encoded; its receipt says that the log holds it, on the disk.

        Where no receipt comes, the same bytes are sent again, until the time limit; the service takes them once.
        """
        key = self._keys.form(f"ingest_{kind}").make(robot=robot)
        part = self._ask(
            key, "", timeout, Answer.single, payload=message, encoding=INPUT_ENCODINGS[kind], attempt=RECEIPT_S
        )
        return read_model(part, Receipt)

    def _tiles(self, asked: TileQuery, level: int, timeout: float | None) -> list[Tile]:
        def whole(answer: Answer) -> list[Part]:
            parts = answer.whole()
            if not parts:
                self.status(timeout=AGAIN_S * 5)  # no tile, or nobody there? NoAnswer if nobody
            return parts

        return read_tiles(self._ask(self._keys.tiles(level), asked.format(), timeout, whole), asked.layers)

    def _ask(
        self,
        key: str,
        parameters: str,
        timeout: float | None,
        take: Callable[[Answer], T],
        *,
        payload: bytes | None = None,
        encoding: str | None = None,
        attempt: float = float("inf"),
    ) -> T:
        """Ask until ``take`` accepts an answer, or the time limit comes: then its last error is raised."""
        selector = f"{key}?{parameters}" if parameters else key
        deadline = time.monotonic() + (self._timeout if timeout is None else timeout)
        pause = threading.Event()
        while True:
            left = max(deadline - time.monotonic(), 0.001)
            try:
                answer = ask(self._session, selector, timeout=min(left, attempt), payload=payload, encoding=encoding)
                return take(answer)
            except QueryRefused as refused:
                if refused.code not in PASSING or time.monotonic() + AGAIN_S >= deadline:
                    raise
            except NoAnswer:
                if time.monotonic() + AGAIN_S >= deadline:
                    raise
            pause.wait(AGAIN_S)


def _open(connect: Sequence[str], timeout: float) -> zenoh.Session:
    """A client session to the first endpoint that answers; it connects again by itself when that one comes back."""
    config = zenoh.Config()
    settings = {
        "mode": "client",
        "scouting/multicast/enabled": not connect,
        "connect/endpoints": list(connect),
        "connect/timeout_ms": int(timeout * 1000),
    }
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = ", ".join(connect) or "any router or service found by scouting"
        raise NoAnswer(f"no connection to {where} within {timeout:g} s ({str(error).splitlines()[0][:120]})") from None
