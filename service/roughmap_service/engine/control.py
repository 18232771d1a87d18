"""Operators' requests: snapshot, reset and forget."""

import time
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from roughmap.arrays import I4, I8
from roughmap.tiles.index import TileBox
from roughmap_schemas import QueryCode, QueryFault
from roughmap_service.engine.sequencer import Sequencer
from roughmap_service.run.settings import NS
from roughmap_service.store.snapshots import Snapshots

TIMEOUT_SECONDS = 30.0
"""How long an operator's request may take: writing millions of tiles takes seconds, and a disk may hang."""


class Control:
    """Carries out operators' requests; each waits at most `TIMEOUT_SECONDS`."""

    def __init__(self, sequencer: Sequencer, snapshots: Snapshots, cut: Callable[[], None]) -> None:
        self._sequencer = sequencer
        self._snapshots = snapshots
        self._cut = cut

    def snapshot(self) -> tuple[int, int]:
        """Store the map as it is now. Return the stored (sequence, epoch)."""
        if not self._snapshots.enabled:
            raise QueryFault(QueryCode.BAD_KEY, "this service has no store (store.path)")
        wanted = self._sequencer.live.run.map.sequence
        until = time.monotonic() + TIMEOUT_SECONDS
        while self._snapshots.sequence < wanted and time.monotonic() < until:
            self._sequencer.call(self._cut, TIMEOUT_SECONDS)
            self._snapshots.wait(TIMEOUT_SECONDS)
            if self._snapshots.error:
                break
        if self._snapshots.sequence < wanted:
            raise QueryFault(QueryCode.INTERNAL, f"no snapshot: {self._snapshots.error or 'it took too long'}")
        return self._snapshots.sequence, self._sequencer.live.view.epoch

    def reset(self) -> tuple[int, int]:
        """Empty the map. Return the new (sequence, epoch)."""
        done: list[tuple[int, int]] = []
        self._sequencer.call(lambda: done.append(self._sequencer.reset()), TIMEOUT_SECONDS)
        return done[0]

    def forget(self, box: TileBox | None, older: float | None, why: str) -> tuple[int, int, int]:
        """Erase the tiles in a box (None: anywhere) without a point in the last ``older`` s (None: whatever their age).

        Return (sequence, epoch) after that, and the number of tiles. ``why`` is for the log line.
        """
        newest_stamp_ns = self._sequencer.live.run.newest_stamp_ns

        def choose(tiles: I4, stamps_ns: I8) -> npt.NDArray[np.bool_]:
            chosen = np.ones(len(tiles), np.bool_)
            if older is not None:
                chosen &= stamps_ns < newest_stamp_ns - older * NS
            if box is not None:
                chosen &= ((tiles >= box[:2]) & (tiles <= box[2:])).all(axis=1)
            return chosen

        done: list[tuple[int, int, int]] = []
        self._sequencer.call(lambda: done.append(self._sequencer.forget(choose, why)), TIMEOUT_SECONDS)
        return done[0]
