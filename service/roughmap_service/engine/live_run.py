"""The live run: messages are logged before they are applied, and events before readers can see their effect."""

import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from roughmap.arrays import I4, I8
from roughmap_schemas import (
    Cloud,
    CloudReason,
    Event,
    IntegrationEvent,
    MessageFault,
    Odometry,
    Receipt,
    Refusal,
    ResetEvent,
    Transform,
    encode_event,
)
from roughmap_schemas.kinds import Kind
from roughmap_service.engine.figures import LostCloud
from roughmap_service.engine.notices import Notices
from roughmap_service.host.counters import Counters
from roughmap_service.host.log_lines import note
from roughmap_service.inputs.admission import admit, refuse
from roughmap_service.inputs.queue import InputMessage
from roughmap_service.inputs.streams import Streams
from roughmap_service.journal.items import Sync
from roughmap_service.journal.recorder import Recorder
from roughmap_service.journal.writer import LogWriter
from roughmap_service.run.decoding import decode
from roughmap_service.run.inbox import Arrival, LoggedCloud, Proposal
from roughmap_service.run.keeping import Keeping, not_kept, pieces, present_ns
from roughmap_service.run.odometry_clock import Verdict
from roughmap_service.run.run import NoTimes, Run
from roughmap_service.run.view import View
from roughmap_service.store.memory_limit import MemoryLimit

logger = logging.getLogger(__name__)

Choose = Callable[[I4, I8], npt.NDArray[np.bool_]]
"""Chooses among the (T, 2) tiles of the map, each with its newest stamp."""


class LiveRun:
    """Connects a `Run` to the log, to readers and to the counters; for the sequencer's thread alone.

    ``emptied`` is told which (T, 2) tiles were erased, and at which sequence, with the map held.
    """

    def __init__(
        self,
        run: Run,
        view: View,
        writer: LogWriter,
        recorder: Recorder,
        counters: Counters,
        memory: MemoryLimit,
        streams: Streams,
        publish_event: Callable[[bytes], None],
        emptied: Callable[[I4, int], None],
    ) -> None:
        self.run = run
        self.view = view
        self._writer = writer
        self._recorder = recorder
        self._counters = counters
        self._memory = memory
        self._streams = streams
        self._publish_event = publish_event
        self._emptied = emptied
        self._keeping = Keeping()
        self._robots = set(run.robots)
        self._notices = Notices(counters, streams, run.robots, self._robots)
        self._checkpoint_sequence = 0
        self._unclear: dict[tuple[str, str], str] = {}

    def accept(self, message: InputMessage, now: float) -> int | None:
        """Check a message, log it and apply it. Return its input number.

        A message that is refused (None) or was logged before is counted, and answered if it was ingested. ``now`` as
        for `decide`.
        """
        run = self.run
        try:
            first = run.duplicates.find(message.identity)
            if first is not None and not self._mounts_anew(message):
                self._acknowledge(message, first, duplicate=True)
                return first
            if not self._writer.ok:
                raise log_fault(self._writer.error)
            content = admit(message, run.settings, self._robots, run.inbox)
        except MessageFault as fault:
            self.refuse(message, fault)
            return None
        if isinstance(content, Odometry):
            self._decide_before(message.robot, content, now)
        logged_ns = self._recorder.input(
            message.kind, message.robot, message.payload, message.received_ns, content.stamp_ns, run.input + 1
        )
        arrival = Arrival(message.arrival, promised=message.reply is not None)
        taken = run.take(message.robot, content, message.identity, logged_ns, arrival)
        with unharmed():
            self._notices.message(message.robot, content, taken)
            if isinstance(content, Cloud):
                self._notices.sensor(message.robot, content.frame_id, run.settings.config)
        self._acknowledge(message, taken.input, duplicate=False)
        return taken.input

    def _mounts_anew(self, message: InputMessage) -> bool:
        """Return whether a message that was logged before would change a sensor's mounting: then it counts again.

        So a static transform that is sent after the settings changed, or set back to what it was, is not lost.
        """
        if message.kind is not Kind.TRANSFORM:
            return False
        transform = decode(message.kind, message.payload, self.run.settings)
        robot = self.run.robot(message.robot)
        return isinstance(transform, Transform) and robot.is_mounting(transform) and robot.mountings.differs(transform)

    def refuse(self, message: InputMessage, fault: MessageFault) -> None:
        """Count a message that is not logged, and answer it if it was ingested."""
        refuse(self._counters, self._streams, message.robot, message.kind, fault, message.payload)
        if message.reply is not None:
            message.reply.refuse(fault)

    def advance(self, now: float) -> bool:
        """Reject all clouds that the inbox has given up, so that they don't pile up; then decide at most one cloud."""
        while self.run.inbox.ended and self.decide(now) is not None:
            pass
        return self.decide(now) is not None

    def decide(self, now: float) -> IntegrationEvent | None:
        """Decide at most one cloud; none while the log can't be written.

        ``now`` (monotonic s): all messages that arrived before it have been applied. So no cloud is rejected while its
        poses are still queued behind it.
        """
        if not self._writer.wait_room(0.0):
            return None
        self._find_times(now)
        proposal = self.run.decide(now)
        if proposal is None:
            return None
        self._memory.relieve(self.view.reading)  # before the map is held: it may write to the disk
        begun = time.monotonic()
        event, payload = self._integrate(proposal)
        self._tell(proposal.cloud, event, now, time.monotonic() - begun)
        self._publish_event(payload)
        now_ns = present_ns(self.run.robots.values(), self.run.newest_stamp_ns)
        if self._keeping.due(self.run.settings, now_ns):
            self._forget_by_keep(now_ns)
        return event

    def forget(self, choose: Choose, why: str) -> int:
        """Erase the level-0 tiles that ``choose`` chooses, log it and say so; return their number."""
        with self.view.reading() as rough_map:
            tiles, stamps_ns = rough_map.tile_stamps()
        tiles = tiles[choose(tiles, stamps_ns)]
        for some in pieces(tiles):
            with self.view.change():
                event = self.run.forget(some)
                self._emptied(some, event.sequence)
                payload = self._log(event)
            self._publish_event(payload)
        if len(tiles):
            self._counters.forgotten(len(tiles))
            text = f"forgot {len(tiles)} {'tile' if len(tiles) == 1 else 'tiles'} of the map: {why}"
            note(logger, logging.INFO, "tiles_forgotten", text, tiles=len(tiles))
        return len(tiles)

    def _forget_by_keep(self, now_ns: int) -> None:
        robots, settings = self.run.robots.values(), self.run.settings
        keep = settings.config.map.keep
        limits = [f"farther than {keep.radius:g} m from all robots"] if math.isfinite(keep.radius) else []
        limits += [f"without a point for {keep.age:g} s"] if math.isfinite(keep.age) else []
        why = f"{' or '.join(limits)} (map.keep)"
        self.forget(lambda tiles, stamps_ns: not_kept(tiles, stamps_ns, robots, settings, now_ns), why)

    def checkpoint(self, *, last: bool = False) -> None:
        """Log the map's digest if the map changed since the last checkpoint.

        The ``last`` one of a map that stayed empty is logged too, so that its log can be compared.
        """
        unchanged = self.run.map.sequence == self._checkpoint_sequence and not (last and not self._checkpoint_sequence)
        if unchanged or not self._writer.ok:
            return
        event = self.run.checkpoint()
        self._checkpoint_sequence = event.sequence
        self._publish_event(self._log(event))

    def log_reset(self) -> ResetEvent:
        """Log a reset; `empty` carries it out."""
        event = self.run.next_reset()
        self._log(event)
        return event

    def empty(self, event: ResetEvent, *, publish: bool) -> None:
        """Carry out a logged reset."""
        with self.view.change() as rough_map:
            self._emptied(rough_map.tile_sequences()[0], event.sequence)
            self.run.reset()
            self.view.epoch = self.run.epoch
        if publish:
            self._publish_event(encode_event(event))

    def _decide_before(self, robot: str, odometry: Odometry, now: float) -> None:
        """Decide clouds that have their poses but would lose them by this pose.

        So a recording can be played faster than it was made. Call this before the pose is logged: a replay forgets old
        poses at the same place.
        """
        verdict = self.run.robot(robot).judge(odometry.stamp_ns)
        if verdict in (Verdict.HOLD, Verdict.REPEAT):
            return
        horizon = math.inf if verdict.begins_anew else odometry.stamp_ns - self.run.settings.history_ns
        while self.run.inbox.holds_before(robot, horizon):
            if self.decide(now) is None:
                return

    def _find_times(self, now: float) -> None:
        """Log how the times of waiting clouds are read, once it is known."""
        for found in self.run.find_times(now):
            if isinstance(found, NoTimes):
                self._unclear[found.robot, found.frame_id] = found.seen
            else:
                payload = self._log(found)
                self.run.read_times(found)
                self._publish_event(payload)
            with unharmed():
                self._notices.times(found, self.run.settings.config)

    def _integrate(self, proposal: Proposal) -> tuple[IntegrationEvent, bytes]:
        """Apply a proposal and log the event; return it and its JSON.

        Readers wait only for the change itself: all tiles that it needs are in memory by then. If memory runs out, the
        cloud is rejected as `overload` and the map is unchanged. No replay places it, even with enough memory.
        """
        with ExitStack() as held:
            try:
                change = self.run.place(proposal, self.view.reading, no_new_tiles=self._memory.full)
                held.enter_context(self.view.change())
                event = change()
            except MemoryError:
                event = self.run.place(replace(proposal, outcome=CloudReason.OVERLOAD))()
            payload = self._log(event)
        if event.outcome == CloudReason.OVERLOAD != proposal.outcome:
            logger.error("input %d: not enough memory to place its cloud", event.input)
        return event, payload

    def _tell(self, cloud: LoggedCloud, event: IntegrationEvent, now: float, seconds: float) -> None:
        """Count a decided cloud whose integration took ``seconds``, and tell if its sensor's clouds come to nothing."""
        arrival, rejected = cloud.arrival, {str(reason): n for reason, n in event.rejected.items()}
        came = None if arrival.resumed else arrival.at
        self._counters.cloud(str(event.outcome), event.accepted, rejected, came, seconds)
        run, unclear = self.run, self._unclear.get(cloud.sensor, "")
        lost = LostCloud(cloud, event, run.robots.get(event.robot), run.settings, run.map, now - arrival.at, unclear)
        frame_id = cloud.cloud.frame_id
        with unharmed():
            self._streams.cloud(event.robot, frame_id, str(event.outcome), event.accepted, rejected, lost.figures)

    def _log(self, event: Event) -> bytes:
        """Log an event; return its JSON."""
        self.run.record += 1
        return self._recorder.event(event, time.time_ns())

    def _acknowledge(self, message: InputMessage, number: int, *, duplicate: bool) -> None:
        """Answer an ingested message once it is on disk."""
        if message.reply is None:
            if duplicate:
                self._counters.refuse(Refusal.DUPLICATE)
                text = "they are in the log already"
                self._streams.refused(message.robot, message.kind.value, Refusal.DUPLICATE, text)
            return
        receipt = Receipt(input=number, epoch=self.run.epoch, durable=True, duplicate=duplicate)
        reply = message.reply
        kept = "; the message is queued for the log: send the same bytes again for its receipt"
        self._writer.put(Sync(lambda: reply.receipt(receipt), lambda error: reply.refuse(log_fault(error, kept))))


@contextmanager
def unharmed() -> Iterator[None]:
    """Log an error in what is only told to people: the map must not end with it."""
    try:
        yield
    except Exception:
        logger.exception("cannot tell what came of a message; the map goes on")


def log_fault(error: str, more: str = "") -> MessageFault:
    """Return the refusal of a message while the log can't be written."""
    return MessageFault(Refusal.LOG_UNAVAILABLE, f"the log can't be written: {error}{more}")
