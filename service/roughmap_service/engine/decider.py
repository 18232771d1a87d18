"""Clouds, one at a time: decided, placed in the map, and the event of it logged before anyone can see the result."""

import logging
import time
from collections.abc import Callable
from contextlib import ExitStack

from roughmap_schemas import CloudReason, Event, IntegrationEvent, encode_event
from roughmap_service.host.counters import Counters
from roughmap_service.journal.writer import LogWriter
from roughmap_service.run.apply import RunState
from roughmap_service.run.inbox import Decision, Inbox
from roughmap_service.run.settings import NS
from roughmap_service.run.view import View
from roughmap_service.store.memory_limit import MemoryLimit

log = logging.getLogger(__name__)


class Decider:
    """Decides what waits in the inbox; for the sequencer's thread alone.

    Attributes:
        arrived: when an input came, in monotonic s, until it is decided.
        heard: all that came in until then is taken up: the inbox's clock, so that no cloud ends for want of poses that
            only wait behind it.
        newest_stamp_ns: of the clouds in the map.
    """

    def __init__(
        self,
        state: RunState,
        view: View,
        inbox: Inbox,
        writer: LogWriter,
        counters: Counters,
        memory: MemoryLimit,
        log_event: Callable[[Event], None],
        publish_event: Callable[[bytes], None],
    ) -> None:
        self._state = state
        self._view = view
        self._inbox = inbox
        self._writer = writer
        self._counters = counters
        self._memory = memory
        self._log_event = log_event
        self._publish_event = publish_event
        self.arrived: dict[int, float] = {}
        self.heard = time.monotonic()
        self.newest_stamp_ns = state.map.newest_updated * NS

    def advance(self) -> bool:
        """Decide a cloud, if one can be; all that only has to be told comes before it: it must not pile up behind."""
        while self._inbox.ended and self.decide():
            pass
        return self.decide()

    def decide(self) -> bool:
        """Decide at most one cloud; none while the log can't be written."""
        if not self._writer.wait_room(0.0):
            return False
        decision = self._inbox.tick(self.heard)
        if decision is None:
            return False
        proposal = _proposal(decision, self._state)
        self._memory.relieve(self._view.reading)  # before the map is held: it may write to the disk
        self._state.no_new_tiles = self._memory.full
        begun = time.monotonic()
        done = self._place(proposal)
        took = time.monotonic() - begun
        arrival = self.arrived.pop(done.input, None)
        if done.accepted:
            self.newest_stamp_ns = max(self.newest_stamp_ns, decision.cloud.last_ns)
        rejected = {str(reason): n for reason, n in done.rejected.items()}
        self._counters.cloud(str(done.outcome), done.accepted, rejected, arrival, took)
        self._publish_event(encode_event(done))
        return True

    def _place(self, proposal: IntegrationEvent) -> IntegrationEvent:
        """Apply a decision and log the event. Readers wait only for the change itself: what it takes from the disk is
        in memory by then. A cloud that there is no memory for ends as `overload`: the map is as it was before it, and
        no replay, which may have the memory, places it either."""
        with ExitStack() as held:
            try:
                change = self._state.prepare(proposal, self._view.reading)
                held.enter_context(self._view.change())
                done = change()
            except MemoryError:
                done = self._state.prepare(proposal.model_copy(update={"outcome": CloudReason.OVERLOAD}))()
            self._log_event(done)
        if done.outcome == CloudReason.OVERLOAD != proposal.outcome:
            log.error("input %d: no memory to place its cloud", proposal.input)
        return done


def _proposal(decision: Decision, state: RunState) -> IntegrationEvent:
    cloud = decision.cloud
    return IntegrationEvent(
        epoch=state.epoch,
        input=cloud.input,
        robot=cloud.robot,
        poses=[(pose.input, pose.transform) for pose in decision.poses],
        outcome=decision.outcome,
        accepted=0,
        rejected={},
        sequence=state.map.sequence,
    )
