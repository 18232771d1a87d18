"""The service: wiring only. Each part starts after the parts that it needs; they stop in reverse order."""

import logging
import threading
import time
import uuid
from collections.abc import Callable
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import zenoh

from roughmap_schemas import Config, Keys, configuration_digest
from roughmap_schemas.config_load import LoadedConfig
from roughmap_schemas.faults import ReportedError
from roughmap_service.answers.emptied_tiles import EmptiedHistory
from roughmap_service.answers.events import EventPublisher
from roughmap_service.answers.map_reader import MapReader
from roughmap_service.answers.queryables import Answers
from roughmap_service.answers.records import OutputRecords
from roughmap_service.answers.served_map import ServedMap
from roughmap_service.answers.updates import Updates
from roughmap_service.engine.control import Control
from roughmap_service.engine.live_run import LiveRun
from roughmap_service.engine.recovery import Progress as RecoveryProgress
from roughmap_service.engine.recovery import Recovered, Stopped, begin_new_run, recover, set_aside_damaged
from roughmap_service.engine.sequencer import Intervals, Sequencer
from roughmap_service.engine.warmup import warm_up
from roughmap_service.host.counters import Counters
from roughmap_service.host.ending import Ending
from roughmap_service.host.locks import locked
from roughmap_service.host.log_lines import note
from roughmap_service.http.server import HttpServer
from roughmap_service.inputs.queue import InputQueue
from roughmap_service.inputs.receipts import ReceiptSender
from roughmap_service.inputs.ros2 import Ros2Inputs
from roughmap_service.inputs.ros2_checks import prepare
from roughmap_service.inputs.session import bound_messages, check_exposure, claim, endpoints, open_session, zenoh_config
from roughmap_service.inputs.streams import Streams
from roughmap_service.inputs.subscriptions import ZenohInputs
from roughmap_service.journal.recorder import Recorder
from roughmap_service.journal.writer import LogWriter
from roughmap_service.run.metadata import file_metadata
from roughmap_service.run.view import View
from roughmap_service.store.map_db import Store
from roughmap_service.store.memory_limit import MemoryLimit, keep_freed
from roughmap_service.store.snapshots import Snapshots, cut_of
from roughmap_service.store.spill import Spill
from roughmap_service.watch.parts import RunningParts, connect_pages
from roughmap_service.watch.readiness import Readiness, Sources
from roughmap_service.watch.status import RunProgress, Status, StatusPublisher

logger = logging.getLogger(__name__)

SPILL_NAME = "tiles.spill"
"""The spill file in the log's directory, if map.spill_path names no other."""

LOOK_SECONDS = 0.5
"""How often the main thread checks whether a part has failed or hangs."""


class ServeError(ReportedError):
    """The service can't start; one line that names cause and remedy."""

    exit_code = 2


class ServiceFailed(ReportedError):
    """The service can't continue; one line that names the cause."""


def serve(
    loaded: LoadedConfig,
    stop: threading.Event,
    announce: Callable[[dict[str, Any]], None],
    *,
    fresh: bool = False,
    insecure: bool = False,
    progress: RecoveryProgress | None = None,
) -> None:
    """Serve one map until ``stop`` is set; ``announce`` is called once, when the service is ready.

    ``insecure`` allows a session that anyone on the network can join. Raises ServeError, TransportError, LogError,
    StoreError, IdentityError, ... if the service can't start, ServiceFailed if it can't continue; each is one line.
    """
    config = loaded.config
    keys = Keys(config.map.name, config.keys)
    directory, store = Path(config.log.directory), Store(Path(config.store.path)) if config.store.path else None
    session_config = zenoh_config(loaded)
    bound_messages(session_config, config.input.max_message)
    prepare(session_config, config)
    check_exposure(session_config, loaded, insecure=insecure)
    with ExitStack() as stack:
        stack.enter_context(locked(directory, None if store is None else store.path))
        sources = Sources(Readiness(), config.map.name)
        if config.http.listen is not None:
            sources.url = stack.enter_context(HttpServer(config.http, sources, insecure=insecure)).url
        session = stack.enter_context(open_session(session_config))
        instance = uuid.uuid4().hex
        token, others = claim(session, keys, instance, config.service.alive_wait, stop)
        stack.callback(token.undeclare)  # last: another instance that waits for it may open the log at once
        if others and not stop.is_set():
            raise ServeError(f"map {config.map.name!r} is served already, by {', '.join(others)}; stop that one first")
        keep_freed(config.map.memory_limit)
        warm_up(config, stop)  # before memory is measured, and before the first tile
        path = Path(config.map.spill_path) if config.map.spill_path else directory / SPILL_NAME
        memory = MemoryLimit(config.map.memory_limit, stack.enter_context(Spill(path, config.map.spill_limit)))
        try:
            recovered = _recover(config, directory, store, fresh, progress, stop, memory)
        except Stopped:
            logger.info("stopped before it was ready")
            return
        if stop.is_set():
            return
        try:
            with Service(loaded, session, instance, recovered, store, memory, sources) as service:
                announce(
                    {
                        "ready": True, "map": config.map.name, "instance": instance,
                        "endpoints": endpoints(session), "http": sources.url,
                    }
                )  # fmt: skip
                service.run_until(stop)
            service.check_kept()
        finally:
            if memory.spill.store_damaged and store is not None:
                set_aside_damaged(store, directory, memory.spill.failure)


class Service:
    """A recovered map and the running parts that serve it. A context manager."""

    def __init__(
        self,
        loaded: LoadedConfig,
        session: zenoh.Session,
        instance: str,
        recovered: Recovered,
        store: Store | None,
        memory: MemoryLimit,
        sources: Sources,
    ) -> None:
        self._config = config = loaded.config
        self._session = session
        self._recovered = recovered
        self._store = store
        self._memory = memory
        self._sources = sources
        self._keys = Keys(config.map.name, config.keys)
        self._run_id = recovered.run_id or uuid.uuid4().hex
        self._served = ServedMap(
            config.map.name, self._run_id, instance, configuration_digest(config), config.map.frame_id,
            config.map.surface,
        )  # fmt: skip
        self._run = recovered.run
        self._run.epoch = recovered.epoch
        self._view = View(self._run.map, recovered.epoch)
        self._counters = Counters(config.input.max_wait)
        self._streams = Streams(config)
        self._ending = Ending(config.service.shutdown_timeout)
        self._stack = ExitStack()
        self._log_is_whole = self._sequencer_ended = True

    def __enter__(self) -> Self:
        with ExitStack() as stack:  # stops the started parts if a later one can't start
            self._open_log(stack)
            self._start_sequencer(stack)
            self._start_answers(stack)
            self._let_messages_in(stack)
            self._show(stack)
            stack.callback(self._ending.begin)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def run_until(self, stop: threading.Event) -> None:
        """Check the parts until ``stop`` is set. ServiceFailed if one can't continue."""
        while not stop.wait(LOOK_SECONDS):
            self._parts.watch()
            if not self._sequencer.alive:
                raise ServiceFailed(f"the sequencer failed: {self._sequencer.failure}")
            if self._memory.spill.failure:  # a map that has lost a part must not be served
                raise ServiceFailed(self._memory.spill.failure)
        self._queue.close()

    def check_kept(self) -> None:
        """Raise ServiceFailed if the shutdown lost anything; call this after the service has stopped."""
        if not self._log_is_whole:
            raise ServiceFailed(f"the end of the log is lost: {self._writer.error or 'the disk was not fast enough'}")
        if self._memory.spill.failure:
            raise ServiceFailed(self._memory.spill.failure)
        failure = self._sequencer.failure
        if failure or not self._sequencer_ended:
            why = f"failed: {failure!r}" if failure else "did not end in time"
            left = f"{len(self._run.clouds)} logged clouds are undecided, and the next start decides them"
            raise ServiceFailed(f"the sequencer {why}; {left}; messages that were not logged yet are lost")
        self._ending.kept()

    def _open_log(self, stack: ExitStack) -> None:
        self._receipts = ReceiptSender()
        stack.callback(lambda: self._receipts.close(self._ending.left()))
        config, recovered = self._config, self._recovered
        created_ns = max(time.time_ns(), recovered.not_before_ns)
        self._writer = LogWriter(
            Path(config.log.directory),
            file_metadata(
                self._run_id, self._run, config, epoch=recovered.epoch, index=recovered.index, created_ns=created_ns
            ),
            compression=config.log.compression,
            flush_interval=config.log.flush_interval,
            queue_limit=config.log.queue_limit,
            max_file_bytes=config.log.max_file_bytes,
            max_file_age=config.log.max_file_age,
            last_ns=recovered.last_ns,
            synced=self._counters.log_synced,
        )
        stack.callback(self._close_log)

    def _close_log(self) -> None:
        self._log_is_whole = self._writer.close(self._ending.left(0.9))

    def _start_sequencer(self, stack: ExitStack) -> None:
        config, writer = self._config, self._writer
        stored = None if self._recovered.was_reset else self._recovered.cut
        self._snapshots = Snapshots(
            self._store, self._view, writer, stored, keep=config.log.keep, spill=self._memory.spill
        )
        self._queue = InputQueue(config.input.queue_limit, self._counters)
        self._emptied = EmptiedHistory(config.map.max_tiles)
        events = stack.enter_context(EventPublisher(self._session, self._keys))
        recorder = Recorder(writer, self._keys)
        live = LiveRun(
            self._run, self._view, writer, recorder, self._counters, self._memory, self._streams, events.publish,
            self._emptied.note,
        )  # fmt: skip
        intervals = Intervals(config.log.checkpoint_interval, config.store.snapshot_interval)
        self._sequencer = Sequencer(live, self._queue, writer, self._memory, intervals, self._take_snapshot)
        self._sequencer.start()
        stack.callback(self._end_sequencer)

    def _take_snapshot(self) -> None:
        self._snapshots.offer(lambda: cut_of(self._run_id, self._config, self._run))

    def _end_sequencer(self) -> None:
        """Place what can be placed, checkpoint, snapshot. The log's footer is written after this and needs time too."""
        ending, snapshots = self._ending, self._snapshots
        self._sequencer_ended = self._sequencer.stop(ending.left(0.5))
        self._view.wake()
        if self._sequencer_ended and snapshots.enabled and self._sequencer.failure is None and self._writer.ok:
            snapshots.wait(ending.left(0.3))
            self._take_snapshot()
            snapshots.wait(ending.left(0.5))

    def _start_answers(self, stack: ExitStack) -> None:
        config, view, keys, served = self._config, self._view, self._keys, self._served
        self._parts = RunningParts(
            self._sequencer, self._writer, self._queue, self._snapshots, self._memory, self._counters, self._streams,
            config.log.keep,
        )  # fmt: skip
        self._status = Status(view, self._counters, config, served, version("roughmap"), self._progress)
        control = Control(self._sequencer, self._snapshots, self._take_snapshot)
        records = OutputRecords(self._writer, keys, self._counters, queries=config.log.queries)
        reader = MapReader(view, keys, config, served, self._emptied)
        self._answers = stack.enter_context(
            Answers(
                self._session, reader, config.query, status=self._status,
                control={"snapshot": control.snapshot, "reset": control.reset}, forget=control.forget,
                record_query=records.query,
            )
        )  # fmt: skip
        stack.enter_context(Updates(self._session, reader, config, records.update))
        stack.enter_context(StatusPublisher(self._session, keys, self._status))

    def _progress(self) -> RunProgress:
        return RunProgress(
            durable_sequence=self._writer.durable_sequence,
            input=self._run.input,
            newest_stamp_ns=self._run.newest_stamp_ns,
            waiting=len(self._run.clouds),
            problems=self._parts.problems(),
            lost=self._parts.lost(),
            recent=self._streams.recent.told(),
            log=self._parts.log_state(),
        )

    def _let_messages_in(self, stack: ExitStack) -> None:
        stack.callback(self._queue.close)  # after the subscribers are gone; refuses further messages
        limit = self._config.input.max_message
        stack.enter_context(
            ZenohInputs(self._session, self._keys, self._queue, self._receipts, limit, self._counters, self._streams)
        )
        if self._config.ros2.active:
            self._parts.ros2 = stack.enter_context(
                Ros2Inputs(self._session, self._config, self._queue, self._counters, self._streams)
            )

    def _show(self, stack: ExitStack) -> None:
        connect_pages(self._parts, self._answers, self._sources, self._status, self._config)
        stack.callback(self._parts.end, self._sources)


def _recover(
    config: Config,
    directory: Path,
    store: Store | None,
    fresh: bool,
    progress: RecoveryProgress | None,
    stop: threading.Event,
    memory: MemoryLimit,
) -> Recovered:
    if fresh:
        if store is not None and store.exists():
            logger.warning("a new run; the old store is %s", store.set_aside())
        recovered = begin_new_run(config, directory, memory)
    else:
        recovered = recover(config, directory, store, progress, stop, memory)
    run, epoch = recovered.run, recovered.epoch
    text = f"recovered the map at sequence {run.map.sequence}, epoch {epoch}; {len(run.clouds)} clouds are undecided"
    if recovered.run_id is None:
        text = f"new map {config.map.name!r}"
    note(logger, logging.INFO, "map_recovered", text, sequence=run.map.sequence, epoch=epoch, run=recovered.run_id)
    return recovered
