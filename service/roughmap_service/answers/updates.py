"""Changed tiles, published while there are subscribers."""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from types import TracebackType
from typing import Literal, Self

import numpy as np
import numpy.typing as npt
import zenoh

from roughmap.arrays import I4
from roughmap.reading.frozen import FrozenMap
from roughmap.tiles.index import TileBox
from roughmap_schemas.config import Config
from roughmap_schemas.encodings import GRID
from roughmap_schemas.messages import UpdateRecord, model_bytes
from roughmap_service.answers.drawing import TileForm
from roughmap_service.answers.drawn_tile import DrawnTile
from roughmap_service.answers.map_reader import MapReader

logger = logging.getLogger(__name__)

POLL_SECONDS = 0.5
"""Longest wait before the thread checks whether it must end."""

BACK_SECONDS = 1.0
"""A new subscriber gets the changes of the last one to two of these periods. It may have queried tiles before its
subscription was noticed here, and must not miss the changes in between."""

UpdateKind = Literal["updates", "grids"]
RecordUpdate = Callable[[UpdateKind, bytes, int], None]
"""Takes the log's record of an update: kind, payload (``updates``: JSON `UpdateRecord`, ``grids``: the sent Grid) and
stamp in ns. Must not block."""

Version = tuple[int, int]
"""Epoch and sequence of the map."""

BLOCK_SHIFT = 3
"""Changed tiles are held in blocks of 8 x 8: if two robots work far apart, the tiles between them are not held."""


class Updates:
    """Publishes the tiles of ``updates.levels`` as they change, from a thread of its own.

    Each round publishes all tiles whose sequence rose since the last round. Rounds start at most ``update_hz`` times a
    second, so no tile is published more often, and the last change is always published. Nothing is drawn for a
    level without subscribers. Tiles that were emptied are published once, with known_cells 0.
    """

    def __init__(
        self,
        session: zenoh.Session,
        reader: MapReader,
        config: Config,
        record: RecordUpdate,
    ) -> None:
        self._session = session
        self._reader = reader
        self._view = reader.view
        self._keys = reader.keys
        self._record = record
        self._mode = config.log.updates
        self._period_s = 1.0 / config.updates.update_hz
        self._form = TileForm(tuple(config.updates.layers), reader.tolerance, reader.limits)
        self._levels = tuple(config.updates.levels)
        self._published: dict[int, Version] = {}
        self._back: tuple[float, Version, Version] = (0.0, (0, 0), (0, 0))
        self._subscribed: dict[int, bool] = dict.fromkeys(self._levels, False)
        self._wake = threading.Event()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="updates", daemon=True)
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        version = self._version()
        self._back = (time.monotonic(), version, version)
        for level in self._levels:
            self._watch(level)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self, timeout: float = 2.0) -> None:
        """Publish what is still due, for at most ``timeout`` seconds, and end."""
        self._closing.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout)
        self._stack.close()

    def _watch(self, level: int) -> None:
        """Watch whether a level has subscribers. The publisher serves only this; puts go to the tiles' own keys."""
        form = self._keys.form("updates")
        publisher = self._session.declare_publisher(form.make(z=level, x="*", y="*"))

        def matching(status: zenoh.MatchingStatus) -> None:
            self._subscribed[level] = status.matching
            self._wake.set()

        listener = publisher.declare_matching_listener(matching)
        # The property is a MatchingStatus, despite the stubs. It covers earlier subscribers too.
        if getattr(publisher.matching_status, "matching", publisher.matching_status):
            self._subscribed[level] = True

        def undeclare() -> None:
            if not self._session.is_closed():
                listener.undeclare()
                publisher.undeclare()

        self._stack.callback(undeclare)

    def _version(self) -> Version:
        with self._view.reading() as rough_map:
            return self._view.epoch, rough_map.sequence

    def _run(self) -> None:
        while not self._closing.is_set():
            self._wake.clear()
            levels = self._subscribed_levels()
            for level in [level for level in self._published if level not in levels]:
                del self._published[level]
            if not levels:
                self._remember()
                self._wake.wait(POLL_SECONDS)
                continue
            started = time.monotonic()
            for level in levels:
                self._try_round(level)
            self._remember()
            self._closing.wait(max(0.0, self._period_s - (time.monotonic() - started)))
            oldest = min(self._published.values(), default=(0, 0))
            if set(self._published) == set(self._subscribed_levels()):
                self._view.wait_change(oldest, POLL_SECONDS)
        for level in [level for level in self._published if self._subscribed[level]]:
            self._try_round(level)

    def _subscribed_levels(self) -> list[int]:
        return [level for level in self._levels if self._subscribed[level]]

    def _try_round(self, level: int) -> None:
        """Run one round. An error is logged, and the next round publishes the same changes."""
        try:
            self._round(level)
        except Exception:
            if self._session.is_closed():
                self._closing.set()
            else:
                logger.exception("cannot publish the changes of level %d; trying again in the next round", level)

    def _remember(self) -> None:
        """Remember a version of the map that is one to two ``BACK_SECONDS`` old."""
        taken, newer, older = self._back
        now = time.monotonic()
        if now - taken >= BACK_SECONDS:
            self._back = (now, self._version(), newer)
        else:
            self._back = (taken, newer, older)

    def _round(self, level: int) -> None:
        """Publish the tiles of a level that changed since the last round.

        Only these and the ring around them are held. All other tiles may leave memory, and change without being copied,
        however long a subscriber stalls.
        """
        last_epoch, last_sequence = self._published.setdefault(level, self._back[2])
        with ExitStack() as held:
            with self._view.reading() as rough_map:

                def hold(box: TileBox) -> FrozenMap:
                    frozen = rough_map.freeze(level, box)
                    held.callback(self._view.let_go, frozen)
                    return frozen

                epoch, sequence, emptied = self._view.epoch, rough_map.sequence, self._reader.emptied.now
                was_reset = epoch != last_epoch
                tiles, sequences = rough_map.changed_tiles(level, -1 if was_reset else last_sequence)
                parts = [(hold(box), tiles[rows], sequences[rows]) for box, rows in _blocks(tiles)]
                gone = emptied.tiles(level, tiles, last_sequence)  # subscribers may hold them
                if len(gone):
                    blank = hold((0, 0, 0, 0))  # draws tiles that the map does not have
                    parts.append((blank, gone, np.full(len(gone), sequence)))
            for frozen, some, theirs in parts:
                drawing = self._reader.drawing(frozen, epoch, self._form)
                for (x, y), tile_sequence in zip(some.tolist(), theirs.tolist(), strict=True):
                    self._publish(self._keys.update(level, x, y), drawing.tile(x, y, tile_sequence), sequence)
        self._published[level] = epoch, sequence

    def _publish(self, key: str, drawn: DrawnTile, sequence: int) -> None:
        # BLOCK, since the last change must arrive. A stalled subscriber blocks this thread, and no other, for 5 s at
        # most; then its link is closed.
        self._session.put(
            key,
            drawn.payload,
            encoding=GRID,
            attachment=drawn.attachment(sequence, 1),
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        if self._mode == "records":
            info = drawn.info_in_answer(sequence, 1)
            self._record("updates", model_bytes(UpdateRecord(key=key, info=info)), info.newest_ns)
        elif self._mode == "grids":
            self._record("grids", drawn.payload, drawn.info.newest_ns)


def _blocks(tiles: I4) -> Iterator[tuple[TileBox, npt.NDArray[np.intp]]]:
    """Split the (T, 2) tiles into blocks: the box around the tiles of each block, and their rows."""
    blocks, block_of = np.unique(tiles >> BLOCK_SHIFT, axis=0, return_inverse=True)
    for block in range(len(blocks)):
        rows = np.flatnonzero(block_of.reshape(-1) == block)
        (x0, y0), (x1, y1) = tiles[rows].min(axis=0).tolist(), tiles[rows].max(axis=0).tolist()
        yield (x0, y0, x1, y1), rows
