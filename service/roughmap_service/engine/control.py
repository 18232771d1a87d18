"""What an operator may ask for: a snapshot, a reset."""

import time
from collections.abc import Callable

from roughmap_schemas import QueryCode, QueryFault
from roughmap_service.engine.sequencer import Sequencer
from roughmap_service.store.snapshots import Snapshots


class Control:
    """What an operator may ask for."""

    def __init__(self, sequencer: Sequencer, snapshots: Snapshots, cut: Callable[[], None], timeout: float) -> None:
        self._sequencer = sequencer
        self._snapshots = snapshots
        self._cut = cut
        self._timeout = timeout

    def snapshot(self) -> tuple[int, int]:
        """Store the map as it is now; (sequence, epoch) of what is stored."""
        if not self._snapshots.enabled:
            raise QueryFault(QueryCode.BAD_KEY, "this service has no store (store.path)")
        wanted = self._sequencer.state.map.sequence
        until = time.monotonic() + self._timeout
        while self._snapshots.sequence < wanted and time.monotonic() < until:
            self._sequencer.call(self._cut, self._timeout)
            self._snapshots.wait(self._timeout)
            if self._snapshots.error:
                break
        if self._snapshots.sequence < wanted:
            raise QueryFault(QueryCode.INTERNAL, f"no snapshot: {self._snapshots.error or 'it took too long'}")
        return self._snapshots.sequence, self._sequencer.view.epoch

    def reset(self) -> tuple[int, int]:
        """Empty the map; the (sequence, epoch) that begin with it."""
        done: list[tuple[int, int]] = []
        self._sequencer.call(lambda: done.append(self._sequencer.reset()), self._timeout)
        return done[0]
