"""Operators' requests: snapshot and reset."""

import time
from collections.abc import Callable

from roughmap_schemas import QueryCode, QueryFault
from roughmap_service.engine.sequencer import Sequencer
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
