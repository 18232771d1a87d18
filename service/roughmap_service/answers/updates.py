"""Changed tiles, published while someone listens."""

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
from roughmap_schemas.keys import Keys
from roughmap_schemas.messages import UpdateRecord, model_bytes
from roughmap_service.answers.emptied import Emptied
from roughmap_service.answers.tile_cache import DrawnTile
from roughmap_service.answers.tile_reply import Drawing, Identity, Wanted
from roughmap_service.run.view import View

LOG = logging.getLogger(__name__)

LOOK_S = 0.5
"""How long the thread waits at most before it looks whether it shall end."""

BACK_S = 1.0
"""A new listener is told of what changed in the last one to two of these: it may have asked for tiles, and been
answered, before its subscription was noticed here, and must not miss what came in between."""

UpdateKind = Literal["updates", "grids"]
RecordUpdate = Callable[[UpdateKind, bytes, int], None]
"""Takes what the log keeps of an update: kind, payload (``updates``: JSON `UpdateRecord`, ``grids``: the Grid as sent)
and stamp. It must not block."""

Version = tuple[int, int]

BLOCK_SHIFT = 3
"""Changed tiles are held in blocks of 8 x 8 of them: where two robots work, what lies between them is not."""


class Updates:
    """Publishes, from a thread of its own, the tiles of ``updates.levels`` as they change.

    Each round takes all tiles whose sequence rose since the round before, and rounds start at most ``update_hz`` times
    a second: so no tile comes more often, and the last change always comes. Nothing is made of a level that nobody
    listens to. After a reset the tiles that are gone are published once, with known_cells 0.
    """

    def __init__(
        self,
        session: zenoh.Session,
        view: View,
        keys: Keys,
        config: Config,
        identity: Identity,
        record: RecordUpdate,
        emptied: Emptied,
    ) -> None:
        self._session = session
        self._view = view
        self._keys = keys
        self._identity = identity
        self._record = record
        self._emptied = emptied
        self._mode = config.log.updates
        self._period = 1.0 / config.updates.update_hz
        self._wanted = Wanted(tuple(config.updates.layers), config.map.height_tolerance, dict(config.map.limits))
        self._levels = tuple(config.updates.levels)
        self._told: dict[int, Version] = {}
        self._back: tuple[float, Version, Version] = (0.0, (0, 0), (0, 0))
        self._listened: dict[int, bool] = dict.fromkeys(self._levels, False)
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
        """Publish what is still due, wait for that at most ``timeout`` seconds, and end."""
        self._closing.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout)
        self._stack.close()

    def _watch(self, level: int) -> None:
        """Learn whether anyone listens to a level. The publisher is for this only: puts go to the tiles' own keys."""
        form = self._keys.form("updates")
        publisher = self._session.declare_publisher(form.make(z=level, x="*", y="*"))

        def matching(status: zenoh.MatchingStatus) -> None:
            self._listened[level] = status.matching
            self._wake.set()

        listener = publisher.declare_matching_listener(matching)
        # The property is a MatchingStatus, whatever the stubs say; it tells of those who listen already.
        if getattr(publisher.matching_status, "matching", publisher.matching_status):
            self._listened[level] = True

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
            listened = [level for level in self._levels if self._listened[level]]
            for level in [level for level in self._told if level not in listened]:
                del self._told[level]
            if not listened:
                self._remember()
                self._wake.wait(LOOK_S)
                continue
            started = time.monotonic()
            for level in listened:
                self._tell(level)
            self._remember()
            self._closing.wait(max(0.0, self._period - (time.monotonic() - started)))
            told = min(self._told.values(), default=(0, 0))
            if set(self._told) == {level for level in self._levels if self._listened[level]}:
                self._view.wait_change(told, LOOK_S)
        for level in [level for level in self._told if self._listened[level]]:
            self._tell(level)

    def _tell(self, level: int) -> None:
        """One round; what goes wrong in it is said, and the next round takes it up again."""
        try:
            self._round(level)
        except Exception:
            if self._session.is_closed():
                self._closing.set()
            else:
                LOG.exception("the changes of level %d could not be published; they are tried again", level)

    def _remember(self) -> None:
        """Keep a version of the map that is one to two ``BACK_S`` old."""
        taken, newer, older = self._back
        now = time.monotonic()
        if now - taken >= BACK_S:
            self._back = (now, self._version(), newer)
        else:
            self._back = (taken, newer, older)

    def _round(self, level: int) -> None:
        """Publish what changed at a level since its listeners were last told.

        Only that is held, and the ring around it: all other tiles may leave memory, and are written to without being
        copied, however long a listener stalls.
        """
        told_epoch, told_sequence = self._told.setdefault(level, self._back[2])
        with ExitStack() as held:
            with self._view.reading() as rough_map:

                def hold(box: TileBox) -> FrozenMap:
                    frozen = rough_map.freeze(level, box)
                    held.callback(self._view.let_go, frozen)
                    return frozen

                epoch, sequence, emptied = self._view.epoch, rough_map.sequence, self._emptied.now
                was_reset = epoch != told_epoch
                tiles, sequences = rough_map.changed_tiles(level, -1 if was_reset else told_sequence)
                parts = [(hold(box), tiles[rows], sequences[rows]) for box, rows in _blocks(tiles)]
                blank = hold((0, 0, 0, 0)) if was_reset else None  # draws any tile that is not there
            if blank is not None:  # they may hold tiles from before
                gone = emptied.tiles(level, tiles, told_sequence)
                parts.append((blank, gone, np.full(len(gone), sequence)))
            for frozen, some, theirs in parts:
                drawing = Drawing(frozen, epoch, self._wanted, self._identity)
                for (x, y), tile_sequence in zip(some.tolist(), theirs.tolist(), strict=True):
                    self._publish(self._keys.update(level, x, y), drawing.tile(x, y, tile_sequence), sequence)
        self._told[level] = epoch, sequence

    def _publish(self, key: str, drawn: DrawnTile, sequence: int) -> None:
        # BLOCK, since the last change must come: a reader that stalls holds this thread up for 5 s at most, then its
        # link is closed. Nothing but this thread waits for it.
        self._session.put(
            key,
            drawn.payload,
            encoding=GRID,
            attachment=drawn.told(sequence, 1),
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        if self._mode == "records":
            info = drawn.info.model_copy(update={"map_sequence": sequence, "answer_tiles": 1})
            self._record("updates", model_bytes(UpdateRecord(key=key, info=info)), info.newest_ns)
        elif self._mode == "grids":
            self._record("grids", drawn.payload, drawn.info.newest_ns)


def _blocks(tiles: I4) -> Iterator[tuple[TileBox, npt.NDArray[np.intp]]]:
    """The (T, 2) tiles block by block: the box around those of a block, and which rows they are."""
    blocks, block_of = np.unique(tiles >> BLOCK_SHIFT, axis=0, return_inverse=True)
    for block in range(len(blocks)):
        rows = np.flatnonzero(block_of.reshape(-1) == block)
        (x0, y0), (x1, y1) = tiles[rows].min(axis=0).tolist(), tiles[rows].max(axis=0).tolist()
        yield (x0, y0, x1, y1), rows
