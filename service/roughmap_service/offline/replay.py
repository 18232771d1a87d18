"""Replay: integrate a log again, by its events, and compare with the logged results."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from dataclasses import replace as with_values
from pathlib import Path

from roughmap import STATE_VERSION
from roughmap_schemas import CheckpointEvent, CloudReason, Config, Event, IntegrationEvent, configuration_digest
from roughmap_schemas.faults import ReportedError
from roughmap_service.journal.reader import LogError
from roughmap_service.journal.records import EventRecord, FileStart, LogItem
from roughmap_service.journal.run_files import RunFile, find_files, one_run, read_run
from roughmap_service.run.fold import Step, fold
from roughmap_service.run.inbox import INTEGRATED
from roughmap_service.run.run import Run, RunError
from roughmap_service.run.settings import Settings, new_map
from roughmap_service.store.map_db import Store
from roughmap_service.store.snapshots import take_cut


class ReplayError(ReportedError):
    """The logs can't be replayed as requested; one line."""

    exit_code = 2


@dataclass
class Replayed:
    """The result of a replay.

    ``difference`` is None if everything was equal. ``config`` is the last file's. ``state_version`` is the log's: the
    digests of another version than the present one can't be compared. Then there is no difference, and ``others``
    counts the events that came out otherwise.
    """

    run_id: str
    config: Config
    run: Run
    state_version: int = STATE_VERSION
    checkpoints: int = 0
    events: int = 0
    others: int = 0
    difference: str | None = None

    @property
    def comparable(self) -> bool:
        """Whether the log's digests say anything about the map."""
        return self.state_version == STATE_VERSION

    @property
    def verdict(self) -> str:
        """The last line of `roughmap replay`."""
        if self.difference is not None:
            return f"differs at {self.difference}"
        rough_map = self.run.map
        reached = f"sequence {rough_map.sequence}, digest {rough_map.digest()}"
        if self.comparable:
            return f"equal: {self.checkpoints} checkpoints, {reached}"
        found = f"{self.others} of" if self.others else "all"
        how = "otherwise" if self.others else "as logged"
        return (
            f"not comparable: the log's {self.checkpoints} digests are of state version {self.state_version}, this "
            f"release's of version {STATE_VERSION}; {found} {self.events} events came out {how}; {reached}"
        )


Watch = Callable[[Step], None]


def replay(paths: Sequence[Path], *, from_store: Path | None = None, watch: Watch | None = None) -> Replayed:
    """Integrate the logs again and compare each event and checkpoint; stop at the first difference.

    ``from_store`` is the map.db from which the logs continue, if they do not begin with the run. LogError or
    ReplayError if the logs are not one complete run. An event that can't be applied at its place is a difference. The
    digests of a log of another state version are not compared, and the replay doesn't stop.
    """
    files = one_run(find_files(paths))
    config = config_of(files[0])
    run = Run(Settings(config), new_map(config))
    taken, low_water = _begin(files, run, from_store)
    result = Replayed(files[0].metadata.run, config, run, state_version_of(files))
    reached: LogItem | None = None

    def items() -> Iterator[LogItem]:
        nonlocal reached
        for reached in read_run(files):  # noqa: UP028 - a RunError is about the last item
            yield reached

    try:
        for step in fold(run, items(), taken=taken, low_water=low_water):
            if result.comparable:
                result.difference = _compare(step, run, taken)
                if result.difference is not None:
                    return result
            elif isinstance(step.item, EventRecord) and not isinstance(step.item.event, CheckpointEvent):
                result.others += step.outcome != step.item.event
            if isinstance(step.item, FileStart):
                result.config = step.item.config
            elif isinstance(step.item, EventRecord):
                result.events += 1
                result.checkpoints += isinstance(step.item.event, CheckpointEvent)
            if watch is not None:
                watch(step)
    except RunError as error:
        sequence = reached.event.sequence if isinstance(reached, EventRecord) else run.map.sequence
        result.difference = f"sequence {sequence}: {error}"
        return result
    if from_store is not None and run.record == taken:
        raise ReplayError(
            f"{from_store} already contains all of this log (sequence {run.map.sequence}), so there is nothing to "
            "compare; without --from the whole run is compared"
        )
    if not result.checkpoints:
        raise ReplayError("the logs contain no checkpoint to compare with")
    return result


def what_if(
    paths: Sequence[Path],
    change: Callable[[Config], Config] = lambda config: config,
    *,
    watch: Callable[[Step, Run], None] | None = None,
) -> Run:
    """Integrate the logs again with changed settings, and with the poses that the events name; compare nothing.

    ``change`` is applied to the settings of each file. Errors as `replay`, and RunError if an event can't be applied
    with these settings.
    """
    files = one_run(find_files(paths))
    config = change(config_of(files[0]))
    run = Run(Settings(config), new_map(config))
    _begin(files, run, None)

    def items() -> Iterator[LogItem]:
        for item in read_run(files):
            yield _with_settings(item, change)

    for step in fold(run, items()):
        if watch is not None:
            watch(step, run)
    return run


def _with_settings(item: LogItem, change: Callable[[Config], Config]) -> LogItem:
    """Return a log item as it is under other settings: clouds rejected as `too_many_tiles` are integrated again."""
    if isinstance(item, FileStart):
        return with_values(item, config=change(item.config))
    if isinstance(item, EventRecord) and isinstance(event := item.event, IntegrationEvent):
        outcome = INTEGRATED if event.outcome == CloudReason.TOO_MANY_TILES else event.outcome
        return with_values(item, event=event.model_copy(update={"outcome": outcome}))
    return item


def config_of(file: RunFile) -> Config:
    """Return the settings of a log file; LogError if they can't be read."""
    try:
        return Config.from_log(file.metadata.configuration)
    except ValueError as error:
        raise LogError(f"{file.path}: its configuration can't be read: {str(error).splitlines()[0]}") from None


def state_version_of(files: Sequence[RunFile]) -> int:
    """Return the state version of a run's log; if it has several, one that is not today's."""
    versions = {file.metadata.state_version for file in files}
    return min(versions - {STATE_VERSION}, default=STATE_VERSION)


def _begin(files: Sequence[RunFile], run: Run, from_store: Path | None) -> tuple[int, int]:
    """Bring the state to where the logs begin; return the record and the low-water input there."""
    first = files[0].metadata
    if from_store is None:
        if first.base_sequence or first.first_record > 1:
            raise ReplayError(
                f"{files[0].path.name} begins at record {first.first_record} (sequence {first.base_sequence}), "
                "not at the beginning of the run: add the files before it, or its map.db (--from map.db)"
            )
        return 0, 1
    store = Store(from_store)
    cut = store.read_cut()
    if cut is None:
        raise ReplayError(f"{from_store}: contains no map")
    if cut.run != first.run:
        raise ReplayError(f"{from_store} belongs to run {cut.run[:8]}, the logs to run {first.run[:8]}")
    if cut.record + 1 < first.first_record:
        raise ReplayError(
            f"gap: {from_store} ends at record {cut.record}, the logs begin at record {first.first_record}"
        )
    if first.first_input > cut.low_water:
        raise ReplayError(
            f"gap: the logs begin at input {first.first_input}, but {from_store} needs input {cut.low_water} too"
        )
    if cut.configuration_digest != configuration_digest(run.settings.config):
        raise ReplayError(f"{from_store} and the logs have different settings in [map]")
    store.load_into(run.map, cut)
    take_cut(cut, run)
    return cut.record, cut.low_water


def _compare(step: Step, run: Run, taken: int) -> str | None:
    """Return what differs between a step and the log; None if nothing does."""
    item = step.item
    if isinstance(item, FileStart):
        base = item.metadata
        if base.first_record <= taken or not base.base_digest:
            return None
        found = run.map.sequence, run.map.digest()
        if found != (base.base_sequence, base.base_digest):
            logged = f"{base.base_sequence}, {base.base_digest}"
            return f"sequence {found[0]}: {item.path.name} begins with {logged}; found {found[1]}"
    if isinstance(item, EventRecord) and step.outcome != item.event:
        return _difference(item.event, step.outcome)
    return None


def _difference(logged: Event, found: Event | None) -> str:
    there, here = logged.model_dump(mode="json"), {} if found is None else found.model_dump(mode="json")
    parts = [
        f"{name} {value!r} in the log, {here.get(name)!r} now"
        for name, value in there.items()
        if here.get(name) != value
    ]
    return f"sequence {logged.sequence} ({logged.kind}): {'; '.join(parts)}"
