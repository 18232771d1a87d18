"""Changed tiles, published while someone listens."""

import logging
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, Self

import numpy as np
import numpy.typing as npt
import zenoh

from roughmap_schemas.config import Config
from roughmap_schemas.encodings import GRID
from roughmap_schemas.keys import Keys
from roughmap_schemas.messages import UpdateRecord, model_bytes
from roughmap_service.emptied import Emptied, without
from roughmap_service.tile_reply import Drawing, Identity, Wanted
from roughmap_service.view import View

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


@dataclass(slots=True)
class _Level:
    """What the listeners of a level were told: up to which state, and which tiles they have."""

    version: Version
    tiles: npt.NDArray[np.int32]


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
        self._told: dict[int, _Level] = {}
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
            told = min((state.version for state in self._told.values()), default=(0, 0))
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
        """Publish what changed at a level since its listeners were last told."""
        with self._view.freeze(level) as (frozen, epoch):
            state = self._told.get(level)
            if state is None:
                state = self._told[level] = _Level(self._back[2], frozen.tiles)
                if state.version[0] != epoch:  # the map was reset a moment ago: they may hold tiles from before
                    gone = self._emptied.now.tiles(level, frozen.tiles)
                    state.tiles = np.concatenate([frozen.tiles, gone])
            told_epoch, told_sequence = state.version
            changed = frozen.sequences > (told_sequence if epoch == told_epoch else -1)
            tiles = zip(frozen.tiles[changed].tolist(), frozen.sequences[changed].tolist(), strict=True)
            gone = without(state.tiles, frozen.tiles)
            drawing = Drawing(frozen, epoch, self._wanted, self._identity)
            for (x, y), sequence in [*tiles, *((tile, frozen.sequence) for tile in gone.tolist())]:
                drawn = drawing.tile(x, y, sequence)
                key = self._keys.update(level, x, y)
                # BLOCK, since the last change must come: a reader that stalls holds this thread up for 5 s at most,
                # then its link is closed. Nothing but this thread waits for it.
                self._session.put(
                    key,
                    drawn.payload,
                    encoding=GRID,
                    attachment=drawn.told(frozen.sequence, 1),
                    congestion_control=zenoh.CongestionControl.BLOCK,
                )
                if self._mode == "records":
                    info = drawn.info.model_copy(update={"map_sequence": frozen.sequence, "answer_tiles": 1})
                    record = UpdateRecord(key=key, info=info)
                    self._record("updates", model_bytes(record), info.newest_ns)
                elif self._mode == "grids":
                    self._record("grids", drawn.payload, drawn.info.newest_ns)
            state.version, state.tiles = (epoch, frozen.sequence), frozen.tiles
