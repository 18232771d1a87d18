"""The one thread that numbers inputs, decides clouds and changes the map."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from roughmap import RoughMap
from roughmap_schemas import (
    CheckpointEvent,
    Cloud,
    Event,
    Keys,
    MessageFault,
    Odometry,
    PoseReason,
    Receipt,
    Refusal,
    ResetEvent,
    Transform,
    encode_event,
)
from roughmap_service.engine.decider import Decider
from roughmap_service.host.counters import Counters
from roughmap_service.host.ending import ShuttingDown
from roughmap_service.host.log_lines import note
from roughmap_service.inputs.admission import admit
from roughmap_service.inputs.queue import InputMessage, Intake
from roughmap_service.inputs.subscriptions import refuse
from roughmap_service.journal.items import Rotate, Sync
from roughmap_service.journal.recorder import event_record
from roughmap_service.journal.records import LogRecord
from roughmap_service.journal.writer import LogWriter
from roughmap_service.run.apply import RunState, span
from roughmap_service.run.duplicates import Duplicates
from roughmap_service.run.fold import Content
from roughmap_service.run.inbox import Inbox, WaitingCloud
from roughmap_service.run.view import View
from roughmap_service.store.memory_limit import MemoryLimit

log = logging.getLogger(__name__)

BREATH = 64
"""After so many messages a cloud is decided, though more are there: else a flood of them would stop the map."""

IDLE_SECONDS = 0.5
"""The longest the sequencer sleeps: deadlines come earlier by themselves, this bounds what else may be due."""


class NotFollowed(BaseException):
    """What is in the log could not be done: only a start, which does it again, can go on. No `Exception`, so that it
    ends the sequencer and is not taken for a fault of whoever asked."""


@dataclass(frozen=True, slots=True)
class Intervals:
    """Seconds between checkpoints and between snapshots."""

    checkpoint: float
    snapshot: float


class Sequencer:
    """Takes inputs from the intake to the map.

    Each turn: log and take up all that came in, then decide and place one cloud, so that under load clouds pile up
    where they are counted (the inbox) and poses never wait behind them.
    """

    def __init__(
        self,
        state: RunState,
        view: View,
        writer: LogWriter,
        intake: Intake,
        counters: Counters,
        memory: MemoryLimit,
        duplicates: Duplicates,
        keys: Keys,
        intervals: Intervals,
        publish_event: Callable[[bytes], None],
        take_snapshot: Callable[[], None],
        before_reset: Callable[[RoughMap], None],
    ) -> None:
        self.state = state
        self.inbox = Inbox(state.settings, state.poses)
        self.duplicates = duplicates
        self.view = view
        self._writer = writer
        self._intake = intake
        self._counters = counters
        self._memory = memory
        self._keys = keys
        self._intervals = intervals
        self._publish_event = publish_event
        self._take_snapshot = take_snapshot
        self._before_reset = before_reset
        self._robots = set(state.poses)
        self._checkpoint_sequence = 0
        self._next_checkpoint = time.monotonic() + intervals.checkpoint
        self._next_snapshot = time.monotonic() + intervals.snapshot
        self._stopping = threading.Event()
        self.decider = Decider(state, view, self.inbox, writer, counters, memory, self._log_event, publish_event)
        self.turned = time.monotonic()
        """When it last began a turn: whoever asks whether it still works looks at this."""
        self.failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="sequencer", daemon=True)

    @property
    def log_ok(self) -> bool:
        """Whether the log can be written; where not, no cut of the run could be stored."""
        return self._writer.ok

    @property
    def alive(self) -> bool:
        """Whether the thread is at work."""
        return self._thread.is_alive()

    def start(self, undecided: list[tuple[int, str, int]]) -> None:
        """Begin; clouds logged before a restart and not decided (input, robot, bytes) wait anew."""
        now = time.monotonic()
        for number, robot, size in undecided:
            first, last = span(self.state.clouds[number])
            self.inbox.feed(
                WaitingCloud(number, robot, self.state.clouds[number], first, last, now, size, promised=True)
            )
        self._thread.start()

    def stop(self, timeout: float) -> bool:
        """Take up what was queued, place what can be placed, final checkpoint; False if that takes too long."""
        self._intake.close()
        self._stopping.set()
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def call(self, action: Callable[[], None], timeout: float) -> None:
        """Have ``action`` done between two inputs, and wait for it; its exception is raised here."""
        done = threading.Event()
        raised: list[Exception] = []

        def run() -> None:
            try:
                action()
            except Exception as error:  # noqa: BLE001 - it is the caller's, and raised there
                raised.append(error)
            except NotFollowed as error:
                raised.append(ShuttingDown(str(error)))
                raise
            finally:
                done.set()

        self._intake.command(run)
        if not done.wait(timeout):
            if not self._writer.ok:
                raise _log_fault(self._writer.error, "; what was asked for may still be done when it can")
            raise ShuttingDown("the sequencer did not come to it in time")
        if raised:
            raise raised[0]

    def reset(self) -> tuple[int, int]:
        """Empty the map: a new epoch, durable before anyone sees it; (sequence, epoch) that begin with it. Once logged
        it comes before all else: while the disk fails, messages are refused, nothing is decided. Call it by `call`."""
        event = ResetEvent(epoch=self.state.epoch + 1, sequence=self.state.map.sequence + 1)
        if not self._writer.wait_room(IDLE_SECONDS):
            raise _log_fault(self._writer.error)
        try:
            self._log_event(event)
            durable = self._empty(event)
        except Exception as error:
            why = f"the logged reset could not be done: {type(error).__name__}: {error}; the next start does it"
            raise NotFollowed(why) from error
        if not durable:
            raise ShuttingDown("the service ends; the next start does the reset if the log still gets it to the disk")
        return event.sequence, event.epoch

    def _empty(self, event: ResetEvent) -> bool:
        """Do a reset that is in the log, once it is on the disk; False if the end comes before that."""
        synced = threading.Event()
        self._writer.put(Sync(synced.set))
        while not synced.wait(IDLE_SECONDS):
            if self._stopping.is_set():
                break  # nobody sees the map any more; what is logged behind the reset must be of the emptied one
            if not self._writer.ok:
                self._turn_away()
        with self.view.change() as rough_map:
            self._before_reset(rough_map)
            self.state.apply(event)
            self.view.epoch = self.state.epoch
        self.decider.newest_stamp_ns = 0
        durable = synced.is_set()
        if durable:
            self._publish_event(encode_event(event))
        return durable

    def _run(self) -> None:
        try:
            self.checkpoint()  # what was recovered: the last one before a kill may lie behind it, or never came
            busy = True
            while not self._stopping.is_set():
                busy = self._turn(0.0 if busy else self._wait_seconds())
            while self._turn(0.0):
                pass
            if not self._checkpoint_sequence:
                self._checkpoint_sequence = -1  # the log of a map that stayed empty can be compared too
            self.checkpoint()
        except BaseException as error:
            self.failure = error
            log.critical("the sequencer failed: %s: %s", type(error).__name__, error, exc_info=error)

    def _turn(self, timeout: float) -> bool:
        """One turn; True if it found something to do."""
        self.turned = time.monotonic()
        messages, commands, heard = self._intake.take(timeout)
        for number, message in enumerate(messages, 1):
            self._accept(message)
            if number % BREATH == 0:
                self.decider.advance()
        self.decider.heard = heard
        for command in commands:
            command()
        decided = self.decider.advance()
        if not decided and not messages:  # readers and queues take memory too
            self._memory.relieve(self.view.reading)
        now = time.monotonic()
        if now >= self._next_checkpoint:
            self.checkpoint()
            self._next_checkpoint = now + self._intervals.checkpoint
        if self._writer.wants_rotation():
            self.checkpoint()
            self._writer.put(Rotate(self.state.map.digest()))
        if now >= self._next_snapshot:
            self._take_snapshot()
            self._next_snapshot = now + self._intervals.snapshot
        return bool(messages) or bool(commands) or decided

    def _turn_away(self) -> None:
        """A turn while a reset waits for a log that can't be written: what came in is refused, commands wait."""
        self.turned = time.monotonic()
        messages, commands, _ = self._intake.take(0.0)
        for message in messages:
            self._refuse(message, _log_fault(self._writer.error))
        for command in commands:
            self._intake.command(command)
        self._memory.relieve(self.view.reading)

    def _wait_seconds(self) -> float:
        now = time.monotonic()
        due = [self._next_checkpoint, self._next_snapshot, now + IDLE_SECONDS]
        deadline = self.inbox.deadline()
        if deadline is not None and self._writer.wait_room(0.0):
            due.append(deadline)
        return max(min(due) - now, 0.0)

    def _accept(self, message: InputMessage) -> None:
        """Check, number, log and take up one input; whatever is refused is counted, and answered if it asked."""
        # A log that can't be written is not waited for: every message would hold up all others, the refusals too.
        while self._writer.ok and not self._writer.wait_room(IDLE_SECONDS) and not self._stopping.is_set():
            pass  # the disk is slow: the intake, behind us, drops and counts meanwhile
        try:
            first = self.duplicates.find(message.identity)
            if first is not None:
                self._acknowledge(message, first, duplicate=True)
                return
            if not self._writer.ok:
                raise _log_fault(self._writer.error)
            content = admit(message, self.state.settings, self._robots, self.inbox)
        except MessageFault as fault:
            self._refuse(message, fault)
            return
        if isinstance(content, Odometry):
            self._make_way(message.robot, content.stamp_ns)
        if message.robot not in self._robots:
            self._robots.add(message.robot)
            note(log, logging.INFO, "robot", f"robot {message.robot} is heard for the first time", robot=message.robot)
        number = self.state.input = self.state.input + 1
        self.state.record += 1
        topic = self._keys.form(message.kind).make(robot=message.robot)
        self._writer.put(LogRecord(message.kind, topic, message.payload, message.received_ns, content.stamp_ns, number))
        self.duplicates.add(message.identity, number)
        self._take_up(number, message, content)
        self._acknowledge(message, number, duplicate=False)

    def _make_way(self, robot: str, stamp_ns: int) -> None:
        """Decide clouds that a pose of this stamp would make late, though they have their poses and only wait for their
        turn: so that a recording may be fed faster than it was made. It must come before the pose is logged, since a
        replay, too, forgets old poses at that place."""
        horizon = stamp_ns - self.state.settings.history_ns
        while self.inbox.holds_before(robot, horizon):
            if not self.decider.decide():
                return

    def _refuse(self, message: InputMessage, fault: MessageFault) -> None:
        refuse(self._counters, message.robot, fault)
        if message.reply is not None:
            message.reply.refuse(fault)

    def _take_up(self, number: int, message: InputMessage, content: Content) -> None:
        if isinstance(content, Cloud):
            self.state.take_cloud(number, content)
            first, last = span(content)
            self.decider.arrived[number] = message.arrival
            promised, size = message.reply is not None, content.held_bytes
            self.inbox.feed(WaitingCloud(number, message.robot, content, first, last, message.arrival, size, promised))
        elif isinstance(content, Odometry):
            reason, was_reset = self.state.take_odometry(number, message.robot, content)
            self._counters.pose(reason)
            if was_reset:
                text = f"robot {message.robot}: its clock was reset; its poses begin anew"
                note(log, logging.WARNING, "clock_reset", text, robot=message.robot)
                self.inbox.clock_reset(message.robot)
        elif isinstance(content, Transform):
            self._take_transform(number, message.robot, content)

    def _take_transform(self, number: int, robot: str, transform: Transform) -> None:
        before = self.state.poses[robot].jumps if robot in self.state.poses else 0
        if self.state.take_transform(number, robot, transform) is not None:
            self._counters.pose(PoseReason.POSE_FRAME)
        elif self.state.poses[robot].jumps > before:
            self._counters.jump(robot)
            text = f"robot {robot}: its transform to {transform.parent_frame_id} jumped; ground mapped before stays"
            note(log, logging.WARNING, "jump", text, robot=robot, child_frame_id=transform.child_frame_id)

    def _acknowledge(self, message: InputMessage, number: int, *, duplicate: bool) -> None:
        if message.reply is None:
            if duplicate:
                self._counters.refuse(Refusal.DUPLICATE)
            return
        receipt = Receipt(input=number, epoch=self.state.epoch, durable=True, duplicate=duplicate)
        reply = message.reply
        kept = "; the message is kept and written first when it can: send the same bytes again for its receipt"
        self._writer.put(Sync(lambda: reply.receipt(receipt), lambda error: reply.refuse(_log_fault(error, kept))))

    def checkpoint(self) -> None:
        """Log the map's digest, if the map changed since the last one."""
        if self.state.map.sequence == self._checkpoint_sequence or not self._writer.ok:
            return
        event = self.state.apply(CheckpointEvent(epoch=0, sequence=0, digest="0" * 32))
        self._checkpoint_sequence = self.state.map.sequence
        self._log_event(event)
        self._publish_event(encode_event(event))

    def _log_event(self, event: Event) -> None:
        self.state.record += 1
        self._writer.put(event_record(self._keys.events, event, time.time_ns()))


def _log_fault(error: str, more: str = "") -> MessageFault:
    return MessageFault(Refusal.LOG_UNAVAILABLE, f"the log can't be written: {error}{more}")
