"""Services that are none: queryables on real sessions that answer as a test wants them to."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import zenoh
from net import WAIT_S

from roughmap_schemas import QueryError, TileInfo, encode_grid, model_bytes
from roughmap_schemas.encodings import GRID, json_encoding

Pair = tuple[zenoh.Session, zenoh.Session]

ONE, OTHER = "1" * 32, "2" * 32
"""Two instances."""


def info(x: int = 0, y: int = 0, **changed: object) -> TileInfo:
    """What comes with a tile; ``changed`` are members to be different."""
    given = {
        "map": "site", "instance": ONE, "epoch": 3, "z": 0, "x": x, "y": y, "sequence": 7, "map_sequence": 9,
        "answer_tiles": 1, "oldest_ns": 1, "newest_ns": 2, "known_cells": 4096, "digest": "a" * 32,
        "configuration_digest": "b" * 32, "compression": None,
    }  # fmt: skip
    return TileInfo.model_validate({**given, **changed})


def grid(layers: tuple[str, ...] = ("mean_height",), side: int = 64, value: float = 1.5) -> bytes:
    """A grid of one value."""
    return encode_grid(dict.fromkeys(layers, np.full((side, side), value)), (0.0, 0.0), 0.1, 2, "map")


def send_tile(query: zenoh.Query, tile: TileInfo, payload: bytes | None = None) -> None:
    """One tile reply."""
    key = f"maps/site/tiles/{tile.z}/{tile.x}/{tile.y}"
    query.reply(key, grid() if payload is None else payload, encoding=GRID, attachment=model_bytes(tile))


def refuse(query: zenoh.Query, code: str) -> None:
    """One error reply."""
    error = model_bytes(QueryError(code=code, message="as the test wants it"))
    query.reply_err(error, encoding=json_encoding("QueryError"))


class Matched:
    """Whether a session has heard of a queryable on a key; before that a question finds nobody."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._changed = threading.Condition()
        self._is = False
        self._key = key
        self._querier = session.declare_querier(key, target=zenoh.QueryTarget.ALL_COMPLETE)
        self._listener = self._querier.declare_matching_listener(lambda status: self._set(status.matching))
        self._set(getattr(self._querier.matching_status, "matching", self._querier.matching_status))

    def _set(self, value: bool) -> None:
        with self._changed:
            self._is = value
            self._changed.notify_all()

    def wait(self, value: bool) -> None:
        """Wait until it is so."""
        with self._changed:
            assert self._changed.wait_for(lambda: self._is == value, WAIT_S), f"somebody on {self._key}: not {value}"

    def close(self) -> None:
        """End."""
        self._listener.undeclare()
        self._querier.undeclare()


@contextmanager
def foreign(pair: Pair, key: str, answer: Callable[[zenoh.Query], object], *, end: bool = True) -> Iterator[None]:
    """A queryable on the first session, heard of by the second, and gone for both at the end.

    Each query ends when ``answer`` returns, or with ``end`` False when it is dropped.
    """

    def handle(query: zenoh.Query) -> None:
        if not end:
            answer(query)
            return
        with query:
            answer(query)

    matched = Matched(pair[1], key)
    queryable = pair[0].declare_queryable(key, zenoh.handlers.Callback(handle, indirect=True), complete=True)
    try:
        matched.wait(True)
        yield
    finally:
        queryable.undeclare()
        matched.wait(False)
        matched.close()
