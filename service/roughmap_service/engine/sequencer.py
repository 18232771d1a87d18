"""The one thread that numbers inputs, decides clouds and changes the map."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from roughmap_schemas import ResetEvent
from roughmap_service.engine.live_run import Choose, LiveRun, log_fault
from roughmap_service.host.ending import ShuttingDown
from roughmap_service.inputs.queue import InputQueue
from roughmap_service.journal.items import Rotate, Sync
from roughmap_service.journal.writer import LogWriter
from roughmap_service.store.memory_limit import MemoryLimit

logger = logging.getLogger(__name__)

BREATH = 64
"""A cloud is decided after this many messages even if more are queued: a flood of them must not stop the map."""

IDLE_SECONDS = 0.5
"""The longest the sequencer sleeps. Deadlines wake it earlier; this bounds the wait for everything else."""

PATIENCE_SECONDS = 0.1
"""The longest that poses wait to be taken together while no cloud waits for them."""

MEMORY_SECONDS = 0.1
"""The time between two looks at the memory while nothing is decided: readers and queues take memory too."""


class NotFollowed(BaseException):
    """A logged change could not be carried out; the next start carries it out.

    Not an `Exception`: it ends the sequencer and must not pass for an error of the operator's request.
    """


@dataclass(frozen=True, slots=True)
class Intervals:
    """Seconds between checkpoints and between snapshots."""

    checkpoint: float
    snapshot: float


class Sequencer:
    """Takes messages from the input queue into the map.

    Each turn: accept all messages that arrived, then decide and place one cloud. So under load clouds pile up in the
    inbox, where they are counted, and poses never wait behind them.
    """

    def __init__(
        self,
        live: LiveRun,
        queue: InputQueue,
        writer: LogWriter,
        memory: MemoryLimit,
        intervals: Intervals,
        take_snapshot: Callable[[], None],
    ) -> None:
        self.live = live
        self._queue = queue
        self._writer = writer
        self._memory = memory
        self._intervals = intervals
        self._take_snapshot = take_snapshot
        self._heard = time.monotonic()  # all messages that arrived before it are applied
        self._decided = True  # in the last turn
        self._next_look = 0.0
        self._next_checkpoint = time.monotonic() + intervals.checkpoint
        self._next_snapshot = time.monotonic() + intervals.snapshot
        self._stopping = threading.Event()
        self.turned = time.monotonic()
        """When the last turn began, in monotonic s. It shows whether the sequencer hangs."""
        self.failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="sequencer", daemon=True)

    @property
    def alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Start the thread; clouds that a restart left undecided wait again."""
        self.live.run.resume(time.monotonic())
        self._thread.start()

    def stop(self, timeout: float) -> bool:
        """Accept what was queued, place what can be placed, write the last checkpoint; False if ``timeout`` s pass."""
        self._queue.close()
        self._stopping.set()
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def call(self, action: Callable[[], None], timeout: float) -> None:
        """Run ``action`` between two messages and wait for it; its exception is raised here."""
        done = threading.Event()
        raised: list[Exception] = []

        def run() -> None:
            try:
                action()
            except Exception as error:  # noqa: BLE001 - raised in the caller's thread
                raised.append(error)
            except NotFollowed as error:
                raised.append(ShuttingDown(str(error)))
                raise
            finally:
                done.set()

        self._queue.command(run)
        if not done.wait(timeout):
            if not self._writer.ok:
                raise log_fault(self._writer.error, "; the request may still be carried out once it can be written")
            raise ShuttingDown(f"the sequencer did not get to the request within {timeout:g} s")
        if raised:
            raise raised[0]

    def reset(self) -> tuple[int, int]:
        """Empty the map. Return the new (sequence, epoch). Run it by `call`.

        The new epoch is durable before readers see it. Once the reset is logged, nothing may come before it: while the
        disk fails, messages are refused and no cloud is decided.
        """
        if not self._writer.wait_room(IDLE_SECONDS):
            raise log_fault(self._writer.error)
        try:
            event = self.live.log_reset()
            durable = self._empty(event)
        except Exception as error:
            why = f"the logged reset failed: {type(error).__name__}: {error}; the next start carries it out"
            raise NotFollowed(why) from error
        if not durable:
            raise ShuttingDown("the service is stopping; the next start carries out the reset if it reached the disk")
        return event.sequence, event.epoch

    def forget(self, choose: Choose, why: str) -> tuple[int, int, int]:
        """Erase the tiles that ``choose`` chooses. Return (sequence, epoch, number of tiles). Run it by `call`."""
        if not self._writer.wait_room(IDLE_SECONDS):
            raise log_fault(self._writer.error)
        live = self.live
        number = live.forget(choose, why)
        return live.run.map.sequence, live.run.epoch, number

    def _empty(self, event: ResetEvent) -> bool:
        """Carry out a logged reset once it is on disk. Return False if the service stops before that."""
        synced = threading.Event()
        self._writer.put(Sync(synced.set))
        while not synced.wait(IDLE_SECONDS):
            if self._stopping.is_set():
                break  # no reader is left; what is logged after the reset must be about the emptied map
            if not self._writer.ok:
                self._refuse_messages()
        durable = synced.is_set()
        self.live.empty(event, publish=durable)
        return durable

    def _run(self) -> None:
        try:
            self.live.checkpoint()  # of what was recovered: the last one may be missing after a kill
            while not self._stopping.is_set():
                self._turn(self._wait_seconds())
            while self._turn(0.0):
                pass
            self.live.checkpoint(last=True)
        except BaseException as error:
            self.failure = error
            logger.critical("the sequencer failed: %s: %s", type(error).__name__, error, exc_info=error)

    def _turn(self, timeout: float) -> bool:
        """Make one turn. Return whether there was something to do."""
        self.turned = time.monotonic()
        waiting = self.live.run.inbox.deadline() is not None
        messages, commands, heard = self._queue.take(timeout, 0.0 if waiting else PATIENCE_SECONDS)
        for number, message in enumerate(messages, 1):
            self._wait_for_log()
            self.live.accept(message, self._heard)
            if number % BREATH == 0:
                self.live.advance(self._heard)
        self._heard = heard
        for command in commands:
            command()
        self._decided = self.live.advance(heard)
        self._do_what_is_due()
        return bool(messages) or bool(commands) or self._decided

    def _do_what_is_due(self) -> None:
        """Checkpoint, rotate the log, take a snapshot and make room in memory if due."""
        now = time.monotonic()
        waiting = self.live.run.inbox.deadline() is not None
        if (self._decided and not waiting) or now >= self._next_look:  # before each cloud it is looked at anyway
            self._memory.relieve(self.live.view.reading)
            self._next_look = now + MEMORY_SECONDS
        if now >= self._next_checkpoint:
            self.live.checkpoint()
            self._next_checkpoint = now + self._intervals.checkpoint
        if self._writer.wants_rotation():
            self.live.checkpoint()
            self._writer.put(Rotate(self.live.run.map.digest()))
        if now >= self._next_snapshot:
            self._take_snapshot()
            self._next_snapshot = now + self._intervals.snapshot

    def _wait_for_log(self) -> None:
        """Wait while the disk is slow; meanwhile the input queue drops and counts. Don't wait for a log that can't be
        written: each message would hold up all others, refusals too."""
        while self._writer.ok and not self._writer.wait_room(IDLE_SECONDS) and not self._stopping.is_set():
            pass

    def _refuse_messages(self) -> None:
        """Make a turn while a reset waits for a log that can't be written: refuse messages, keep commands."""
        self.turned = time.monotonic()
        messages, commands, _ = self._queue.take(0.0)
        for message in messages:
            self.live.refuse(message, log_fault(self._writer.error))
        for command in commands:
            self._queue.command(command)
        self._memory.relieve(self.live.view.reading)

    def _wait_seconds(self) -> float:
        """Return how long to wait for messages. Only right after a decision may more clouds be due for one."""
        deadline = self.live.run.inbox.deadline()
        if self._decided and deadline is not None:
            return 0.0
        now = time.monotonic()
        due = [self._next_checkpoint, self._next_snapshot, now + IDLE_SECONDS]
        if deadline is not None and self._writer.wait_room(0.0):
            due.append(deadline)
        return max(min(due) - now, 0.0)
