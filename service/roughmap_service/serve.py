"""The service: everything wired together, from the recovered map to the last fsync."""

import logging
import threading
import time
import uuid
from collections.abc import Callable
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import Any

import zenoh

from roughmap_schemas import Config, Keys, QueryRecord, RunMetadata, configuration_digest, model_bytes
from roughmap_schemas.config_load import LoadedConfig
from roughmap_schemas.encodings import json_encoding
from roughmap_schemas.kinds import Kind
from roughmap_schemas.messages import LogState
from roughmap_service.answers.queryables import Answers
from roughmap_service.answers.reset_history import ResetHistory
from roughmap_service.answers.served_map import ServedMap
from roughmap_service.answers.updates import Updates
from roughmap_service.engine.control import Control
from roughmap_service.engine.recovery import Progress as RecoveryProgress
from roughmap_service.engine.recovery import Recovered, Stopped, begin_anew, put_away, recover
from roughmap_service.engine.sequencer import Intervals, Sequencer
from roughmap_service.engine.warmup import warm_up
from roughmap_service.host.counters import Counters
from roughmap_service.host.ending import Ending
from roughmap_service.host.locks import locked
from roughmap_service.host.log_lines import note
from roughmap_service.http.server import HttpServer
from roughmap_service.inputs.queue import Intake
from roughmap_service.inputs.receipts import Replies
from roughmap_service.inputs.session import (
    bound_messages,
    check_exposure,
    claim,
    endpoints,
    open_session,
    zenoh_config,
)
from roughmap_service.inputs.subscriptions import ZenohInputs
from roughmap_service.journal.file import LogRecord
from roughmap_service.journal.writer import LogWriter
from roughmap_service.run.view import View
from roughmap_service.store.map_db import Store
from roughmap_service.store.memory_limit import Memory, keep_freed
from roughmap_service.store.snapshots import Snapshots, cut_of
from roughmap_service.store.spill import Spill
from roughmap_service.watch.parts import RunningParts, connect_pages
from roughmap_service.watch.readiness import Readiness, Sources
from roughmap_service.watch.status import RunProgress, Status, StatusPublisher

log = logging.getLogger(__name__)

VERSION = version("roughmap")

SPILL_NAME = "tiles.spill"
"""The spill file in the log's directory, if no other is named."""


class ServeError(Exception):
    """The service can't start; one line that names the cause and the mend."""


class ServiceFailed(Exception):
    """The service can't go on; one line that names the cause."""


def serve(
    loaded: LoadedConfig,
    stop: threading.Event,
    announce: Callable[[dict[str, Any]], None],
    *,
    fresh: bool = False,
    insecure: bool = False,
    progress: RecoveryProgress | None = None,
) -> None:
    """Keep one map until ``stop`` is set; ``announce`` is called once, when it is ready.

    ``insecure`` allows a session that whoever is on the network can join.

    Raises what stands in the way of a start (ServeError, TransportError, LogError, StoreError, IdentityError, ...),
    each in one line.
    """
    config = loaded.config
    keys = Keys(config.map.name, config.keys)
    directory, store = Path(config.log.directory), Store(Path(config.store.path)) if config.store.path else None
    session_config = zenoh_config(loaded)
    bound_messages(session_config, config.input.max_message)
    check_exposure(session_config, loaded, insecure=insecure)
    with ExitStack() as stack:
        stack.enter_context(locked(directory, None if store is None else store.path))
        sources = Sources(Readiness(), config.map.name)
        if config.http.listen is not None:
            sources.url = stack.enter_context(HttpServer(config.http, sources, insecure=insecure)).url
        session = stack.enter_context(open_session(session_config))
        instance = uuid.uuid4().hex
        token, others = claim(session, keys, instance, config.service.alive_wait, stop)
        stack.callback(token.undeclare)  # last of all: whoever waits for it may then open the log
        if others and not stop.is_set():
            raise ServeError(f"map {config.map.name!r} is served already, by {', '.join(others)}; stop that one first")
        keep_freed(config.map.memory_limit)
        warm_up(config, stop)  # before memory is measured, and before the first tile
        path = Path(config.map.spill_path) if config.map.spill_path else directory / SPILL_NAME
        memory = Memory(config.map.memory_limit, stack.enter_context(Spill(path, config.map.spill_limit)))
        try:
            recovered = _recovered(config, directory, store, fresh, progress, stop, memory)
        except Stopped:
            log.info("ended before it was ready")
            return
        sequence, epoch = recovered.state.map.sequence, recovered.epoch
        undecided = len(recovered.undecided)
        text = f"the map is back at sequence {sequence}, epoch {epoch}; {undecided} clouds are undecided"
        if recovered.run is None:
            text = f"a new map, {config.map.name!r}"
        note(log, logging.INFO, "map_recovered", text, sequence=sequence, epoch=epoch, run=recovered.run)
        if not stop.is_set():
            try:
                _run(loaded, keys, session, instance, directory, store, recovered, memory, stop, announce, sources)
            finally:
                if memory.spill.store_damaged and store is not None:
                    put_away(store, directory, memory.spill.failure)


def _run(
    loaded: LoadedConfig,
    keys: Keys,
    session: zenoh.Session,
    instance: str,
    directory: Path,
    store: Store | None,
    recovered: Recovered,
    memory: Memory,
    stop: threading.Event,
    announce: Callable[[dict[str, Any]], None],
    sources: Sources,
) -> None:
    """Start the parts in the order in which they need each other, and end them the other way round."""
    config = loaded.config
    state, run = recovered.state, recovered.run or uuid.uuid4().hex
    state.epoch = recovered.epoch
    served = ServedMap(config.map.name, run, instance, configuration_digest(config), config.map.frame_id)
    counters = Counters(config.input.max_wait)
    view, resets = View(state.map, recovered.epoch), ResetHistory(config.map.max_tiles)
    ending, whole, ended = Ending(config.service.shutdown_timeout), True, True
    with ExitStack() as stack:
        replies = Replies()
        stack.callback(lambda: replies.close(ending.left()))
        writer = _writer(config, directory, _metadata(config, run, recovered), recovered.last_ns, counters)

        @stack.callback
        def close_log() -> None:
            nonlocal whole
            whole = writer.close(ending.left(0.9))

        stored = None if recovered.was_reset else recovered.cut
        snapshots = Snapshots(store, view, writer, stored, keep=config.log.keep, spill=memory.spill)
        intake = Intake(config.input.queue_limit, counters, config.input.pose_queue)
        events = session.declare_publisher(
            keys.events, encoding=json_encoding("Event"), congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_HIGH,
        )  # fmt: skip
        # DROP: events are in the log, and a reader that stalls must not hold up the sequencer. A priority of their own:
        # who waits for room in a link's queue of one priority, as updates and replies do, has all others wait.

        def publish(event: bytes) -> None:
            try:
                events.put(event)
            except zenoh.ZError as error:
                log.warning("an event could not be published: %s", error)

        def cut() -> None:
            snapshots.offer(lambda: cut_of(run, config, state, sequencer.inbox, recovered.duplicates))

        sequencer = Sequencer(
            state, view, writer, intake, counters, memory, recovered.duplicates, keys,
            Intervals(config.log.checkpoint_interval, config.store.snapshot_interval),
            publish_event=publish, take_snapshot=cut, before_reset=resets.note,
        )  # fmt: skip
        control = Control(sequencer, snapshots, cut, config.service.control_timeout)

        parts = RunningParts(sequencer, writer, intake, snapshots, memory, counters)

        def progress() -> RunProgress:
            return RunProgress(
                durable_sequence=writer.durable_sequence,
                input=state.input,
                newest_stamp_ns=sequencer.decider.newest_stamp_ns,
                waiting=len(state.clouds),
                problems=parts.problems(),
                log=LogState(file=str(writer.path), bytes=writer.size, ok=writer.ok),
            )

        status = Status(view, counters, config, served, VERSION, progress)
        record = _Outputs(writer, keys, counters, queries=config.log.queries)
        sequencer.start(recovered.undecided)

        @stack.callback
        def end_sequencer() -> None:
            nonlocal ended
            ended = _end(sequencer, view, snapshots, cut, ending)

        answers = stack.enter_context(
            Answers(
                session, view, keys, config, served, status=status,
                control={"snapshot": control.snapshot, "reset": control.reset}, record_query=record.query,
                resets=resets,
            )
        )  # fmt: skip
        stack.enter_context(Updates(session, view, keys, config, served, record.update, resets))
        stack.enter_context(StatusPublisher(session, keys, status))
        stack.callback(intake.close)  # after the subscribers are gone; refuses what still comes
        stack.enter_context(ZenohInputs(session, keys, intake, replies, config.input.max_message, counters))
        connect_pages(parts, answers, sources, status, config)
        stack.callback(parts.end, sources)
        announce(
            {
                "ready": True, "map": config.map.name, "instance": instance, "endpoints": endpoints(session),
                "http": sources.url,
            }
        )  # fmt: skip
        stack.callback(ending.begin)  # first of all, however it comes to its end
        while not stop.wait(0.5):
            parts.watch()
            if not sequencer.alive:
                raise ServiceFailed(f"the sequencer failed: {sequencer.failure}")
            if memory.spill.failure:  # a map of which a part is lost must not be served on
                raise ServiceFailed(memory.spill.failure)
        intake.close()
    if not whole:
        raise ServiceFailed(f"the end of the log is lost: {writer.error or 'the disk did not take it in time'}")
    if memory.spill.failure:
        raise ServiceFailed(memory.spill.failure)
    if sequencer.failure or not ended:
        why = f"failed: {sequencer.failure!r}" if sequencer.failure else "did not end in time"
        left = f"{len(state.clouds)} clouds in the log are undecided, and the next start decides them"
        raise ServiceFailed(f"the sequencer {why}; {left}; what had come and was not logged yet is lost")
    ending.kept()


def _end(sequencer: Sequencer, view: View, snapshots: Snapshots, cut: Callable[[], None], ending: Ending) -> bool:
    """Place what can be placed, checkpoint, snapshot; the log's footer comes after this, and needs time too. False if
    the sequencer did not end in time."""
    ended = sequencer.stop(ending.left(0.5))
    view.wake()
    if ended and snapshots.enabled and sequencer.failure is None and sequencer.log_ok:
        snapshots.close(ending.left(0.3))
        cut()
        snapshots.close(ending.left(0.5))
    return ended


def _recovered(
    config: Config,
    directory: Path,
    store: Store | None,
    fresh: bool,
    progress: RecoveryProgress | None,
    stop: threading.Event,
    memory: Memory,
) -> Recovered:
    if not fresh:
        return recover(config, directory, store, progress, stop, memory)
    if store is not None and store.exists():
        log.warning("a new run; the old store is %s", store.set_aside())
    return begin_anew(config, directory, memory)


def _metadata(config: Config, run: str, recovered: Recovered) -> RunMetadata:
    state = recovered.state
    return RunMetadata(
        run=run,
        created_ns=max(time.time_ns(), recovered.not_before_ns),
        epoch=recovered.epoch,
        index=recovered.index,
        first_input=state.input + 1,
        first_record=state.record + 1,
        base_sequence=state.map.sequence,
        base_digest=state.map.digest(),
        version=VERSION,
        configuration=config.public_dict(),
    )


def _writer(config: Config, directory: Path, metadata: RunMetadata, last_ns: int, counters: Counters) -> LogWriter:
    return LogWriter(
        directory,
        metadata,
        compression=config.log.compression,
        flush_interval=config.log.flush_interval,
        queue_limit=config.log.queue_limit,
        max_file_bytes=config.log.max_file_bytes,
        max_file_age=config.log.max_file_age,
        last_ns=last_ns,
        synced=counters.log_synced,
    )


class _Outputs:
    """What the log keeps of answers and updates: no part of the run, dropped and counted where there is no room."""

    def __init__(self, writer: LogWriter, keys: Keys, counters: Counters, *, queries: bool) -> None:
        self._writer = writer
        self._keys = keys
        self._counters = counters
        self._queries = queries

    def query(self, record: QueryRecord) -> None:
        """One answered query."""
        self._counters.query(record.outcome, record.duration_ns / 1e9)
        if self._queries:
            self._put(Kind.QUERIES, self._keys.queries, model_bytes(record), time.time_ns())

    def update(self, kind: str, payload: bytes, stamp_ns: int) -> None:
        """One published tile."""
        self._put(Kind.GRIDS if kind == "grids" else Kind.UPDATES, self._keys.updates_topic, payload, stamp_ns)

    def _put(self, kind: Kind, topic: str, payload: bytes, stamp_ns: int) -> None:
        if not self._writer.put_output(LogRecord(kind, topic, payload, time.time_ns(), stamp_ns)):
            self._counters.output_dropped("queries" if kind is Kind.QUERIES else "updates")
