"""At start-up: from the store and the log to the map as it was, and to what was still undecided."""

import contextlib
import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from roughmap_schemas import Config, ResetEvent, configuration_digest
from roughmap_schemas.faults import ReportedError
from roughmap_service.host.disk import sync
from roughmap_service.journal.file import FILE_NAME
from roughmap_service.journal.reader import DamagedLog, LogError, has_summary, is_closed, last_log_time, read_metadata
from roughmap_service.journal.records import EventRecord, FileStart, LogItem
from roughmap_service.journal.repair import end_at_damage, least_epoch, repair, set_aside
from roughmap_service.journal.run_files import RunFile, find_files, one_run, read_run
from roughmap_service.run.fold import fold
from roughmap_service.run.run import Run, RunError
from roughmap_service.run.settings import Settings, new_map
from roughmap_service.store.map_db import Cut, DamagedStore, OtherStateVersion, Store, StoreError
from roughmap_service.store.memory_limit import MemoryLimit
from roughmap_service.store.snapshots import take_cut
from roughmap_service.store.stored_tiles import StoredTiles, set_index

log = logging.getLogger(__name__)


class Stopped(Exception):
    """The service was asked to end while it was still on its way to the map."""


class IdentityError(ReportedError):
    """The configuration names another map than the store or log holds."""

    exit_code = 2


@dataclass
class Recovered:
    """Where a run goes on.

    Attributes:
        run: the run, with all that the log holds; its undecided clouds wait for `Run.resume`.
        run_id: None for a new run.
        index: of the run's next log file.
        epoch: with which this start goes on.
        cut: the store's, if there is one.
        was_reset: whether the map was emptied since that cut.
        not_before_ns: the next log file's ``created_ns`` must be at least this, so that this run is the newest in its
            folder whatever the clock says.
        last_ns: log time of the run's last message.
    """

    run: Run
    run_id: str | None = None
    index: int = 0
    epoch: int = 1
    cut: Cut | None = None
    was_reset: bool = False
    not_before_ns: int = 0
    last_ns: int = 0


Progress = Callable[[int, int], None]
"""Told how many of how many log files are folded."""


def recover(
    config: Config,
    directory: Path,
    store: Store | None,
    progress: Progress | None = None,
    stop: threading.Event | None = None,
    memory: MemoryLimit | None = None,
) -> Recovered:
    """Bring back the log directory's newest run, from the store's cut if there is one, else from its beginning.

    With ``memory`` the store's tiles stay in the store until they are needed, and tiles leave memory at its limit. A
    damaged log ends before the damage, a damaged store is built anew, if the log reaches back to the run's beginning;
    what was damaged is named and kept. LogError, StoreError, RunError or IdentityError, each one line, where the map
    can't be had again; Stopped once ``stop`` is set.
    """
    ended: set[Path] = set()
    while True:
        try:
            watch = _Watch(progress, stop or threading.Event(), memory, damaged=bool(ended))
            back = _recover(config, directory, store, watch)
            back.epoch = max(back.epoch, least_epoch(directory, back.run_id))
            return back
        except DamagedLog as damage:
            if damage.path in ended:
                raise
            ended.add(damage.path)
            log.error("%s; the run goes on from what lies before it", damage)
            end_at_damage(damage)
        except DamagedStore as damage:
            if store is None or not set_aside_damaged(store, directory, str(damage)):
                raise
            if memory is not None:
                memory.spill.failure, memory.spill.store_damaged = "", False


def set_aside_damaged(store: Store, directory: Path, damage: str) -> bool:
    """Rename a damaged store, so that the next start builds the map anew; False if the log does not reach that far."""
    files = newest_run(directory, None)
    if not files or files[0].metadata.first_record > 1:
        return False
    log.error("%s; it is %s now, and the map is built anew from the log", damage, store.set_aside_damaged())
    return True


def _recover(config: Config, directory: Path, store: Store | None, watch: "_Watch") -> Recovered:
    outdated = False
    cut: Cut | None = None
    if store is not None:
        try:
            cut = store.read_cut()
        except OtherStateVersion as error:
            log.warning("%s; it is built anew from the log", error)
            outdated = True
    files = newest_run(directory, cut)
    if files:
        check_identity(config, files[-1].metadata.configuration, files[-1].path)
    elif outdated:
        raise LogError(f"{directory}: no log to build the store of another version anew from; start with --fresh")
    result, end = _bring_back(config, store, cut, files, watch)
    if cut is not None and files and end < cut.record:
        result.run.map.reset()  # so that it lets go of what it holds outside memory
        result = _where_the_store_is_ahead(config, store, cut, files, end, watch)
    if outdated and store is not None:
        store.set_aside("outdated")
    return result


def _where_the_store_is_ahead(
    config: Config, store: Store | None, cut: Cut, files: list[RunFile], end: int, watch: "_Watch"
) -> Recovered:
    """The map of the log, if that reaches back to the run's beginning. Else the store's, and the log goes on anew, if a
    damage is to blame: where files are missing, they may be brought back. LogError then."""
    told, first = f"the log ends at record {end}, the store's cut is at {cut.record}", files[0]
    if first.metadata.first_record == 1:
        log.warning("%s: the map is that of the log", told)
        result, _ = _bring_back(config, store, None, files, watch)
    elif not watch.damaged:
        raise LogError(
            f"{told}, and {first.path.name} begins at record {first.metadata.first_record}; "
            "bring back what is missing, or start with --fresh"
        )
    else:
        log.error("%s, and the run's beginning is not there: the map is the store's", told)
        set_aside([file.path for file in files])
        result, _ = _bring_back(config, store, cut, [], watch)
        result.index = files[-1].metadata.index + 1
    result.epoch = max(result.epoch, cut.epoch + 1, files[-1].metadata.epoch + 1)
    return result


@dataclass(frozen=True, slots=True)
class _Watch:
    """Who looks on while files are folded, who may want it to end, what bounds its memory; and whether the log had to
    be ended at a damage."""

    progress: Progress | None
    stop: threading.Event
    memory: MemoryLimit | None
    damaged: bool


def _bring_back(
    config: Config, store: Store | None, cut: Cut | None, files: list[RunFile], watch: _Watch
) -> tuple[Recovered, int]:
    """The run as of the end of its files, begun at the cut, if any; and the last record that the files hold."""
    result = blank(config, watch.memory)
    result.cut = cut
    try:
        return result, _fill(result, config, store, files, watch)
    except BaseException:
        result.run.map.reset()  # so that it lets go of what it holds outside memory
        raise


def _fill(result: Recovered, config: Config, store: Store | None, files: list[RunFile], watch: _Watch) -> int:
    """Take up the cut and the files; the last record that the files hold."""
    cut = result.cut
    taken, low_water = 0, 1
    if cut is not None and store is not None:
        taken, low_water = cut.record, cut.low_water
        _take_cut(config, store, cut, result, watch.memory)
    if not files:
        return 0
    first, last = files[0].metadata, files[-1].metadata
    if not _goes_on(files[0], taken, low_water):
        begun = "there is no store to begin from" if cut is None else f"the store ends at record {cut.record}"
        raise LogError(
            f"{files[0].path.name} begins at record {first.first_record}, input {first.first_input}, and {begun}; "
            "bring back what is missing, or start with --fresh"
        )
    result.run_id, result.index, result.epoch = last.run, last.index + 1, last.epoch + 1
    times = (last_log_time(file.path) for file in reversed(files))
    result.last_ns = next((time for time in times if time), 0)  # they rise over the run; a full file's footer takes 1 s
    while len(files) > 1 and files[1].metadata.first_record <= taken and files[1].metadata.first_input <= low_water:
        files = files[1:]
    end = _fold_files(result, files, taken, low_water, watch)
    result.epoch = max(result.epoch, result.run.epoch + 1)
    result.run.use(Settings(config))
    return end


def blank(config: Config, memory: MemoryLimit | None = None) -> Recovered:
    """The beginning of a run: an empty map at sequence 0, epoch 1."""
    rough_map = new_map(config, None if memory is None else memory.spill)
    return Recovered(Run(Settings(config), rough_map))


def begin_anew(config: Config, directory: Path, memory: MemoryLimit | None = None) -> Recovered:
    """The beginning of a run that is newer than all whose files lie in the directory."""
    result = blank(config, memory)
    for path in directory.glob("*.mcap"):
        if FILE_NAME.fullmatch(path.name):
            with contextlib.suppress(LogError, OSError):  # what can't be read is no run that could be taken for newer
                result.not_before_ns = max(result.not_before_ns, read_metadata(path).created_ns + 1)
    return result


def newest_run(directory: Path, cut: Cut | None) -> list[RunFile]:
    """The files of the cut's run, or of the newest run there; files that a kill left torn are repaired first.

    Without those that can't be read and that the cut doesn't need; DamagedLog for one that is needed.
    """
    ours = [path for path in sorted(directory.glob("*.mcap")) if FILE_NAME.fullmatch(path.name)]
    files: list[RunFile] = []
    unreadable: list[DamagedLog] = []
    last = {path.name.rpartition("-")[0]: path for path in ours}.values()  # of each run
    for path in ours:  # a foreign file is not ours to change
        # The footer may have been under way when the power went.
        repair(path, damaged=path in last and is_closed(path) and not has_summary(path))
        if path.exists():  # one that holds nothing was renamed by the repair
            try:
                files += find_files([path])
            except DamagedLog as damage:
                unreadable.append(damage)
    if not files:
        if unreadable:
            raise unreadable[0]
        return []
    newest = max(files, key=lambda file: file.metadata.created_ns).metadata.run
    if cut is not None and cut.run != newest:
        raise StoreError(
            f"the store is of run {cut.run[:8]}, the newest log of run {newest[:8]}; move one of them away, "
            "or start with --fresh"
        )
    files = [file for file in files if file.metadata.run == newest]
    for fault in unreadable:
        if newest not in fault.path.name:
            continue
        files = [file for file in files if file.path > fault.path]
        if cut is None or not files or not _goes_on(files[0], cut.record, cut.low_water):
            raise fault
        log.error("%s; the store does not need it", fault)
    # A kill may have come between its footer and the fsync: what follows must not outlive it.
    sync(files[-1].path)
    return one_run(files)


def _goes_on(file: RunFile, taken: int, low_water: int) -> bool:
    """Whether nothing is missing between a cut and the file's beginning."""
    return file.metadata.first_record <= taken + 1 and file.metadata.first_input <= low_water


def check_identity(config: Config, stored: dict[str, object], where: Path) -> None:
    """IdentityError that names both values of the first setting that would make it another map."""
    try:
        there = Config.model_validate(stored)
    except ValueError as error:
        raise IdentityError(
            f"{where}: its configuration is of another version ({str(error).splitlines()[0]}); start with --fresh"
        ) from None
    if configuration_digest(there) == configuration_digest(config):
        return
    old, new = there.identity(), config.identity()
    for name, value in new.items():
        if old.get(name) != value:
            raise IdentityError(
                f"map.{name} is {value!r} in the configuration but {old.get(name)!r} in {where}; "
                "set it back, or begin a new run with --fresh"
            )


def _take_cut(config: Config, store: Store, cut: Cut, result: Recovered, memory: MemoryLimit | None) -> None:
    check_identity(config, cut.configuration, store.path)
    run = result.run
    if memory is None:
        store.load_into(run.map, cut)
    else:
        stored = StoredTiles(store)
        places = memory.spill.adopt(stored)
        try:
            set_index(run.map, cut, stored, places)
        except StoreError:
            memory.spill.release(places)
            raise
    if cut.digest and run.map.digest() != cut.digest:
        raise DamagedStore(f"{store.path}: damaged (its tiles are not those of its cut)")
    take_cut(cut, run)
    result.run_id, result.epoch = cut.run, cut.epoch + 1


def _fold_files(result: Recovered, files: list[RunFile], taken: int, low_water: int, watch: _Watch) -> int:
    """Take the files up into the state; the last record that they hold."""
    run = result.run
    done = 0
    end = files[0].metadata.first_record - 1  # it may be that none stands in the files
    own = warned = False

    def items() -> Iterator[LogItem]:
        nonlocal end
        for item in read_run(files):
            if watch.stop.is_set():
                raise Stopped
            end = end if isinstance(item, FileStart) else item.record
            yield item

    for step in fold(run, items(), taken=taken, low_water=low_water):
        item = step.item
        if isinstance(item, FileStart):
            if watch.progress is not None:
                watch.progress(done, len(files))
            done += 1
            own = item.metadata.version == version("roughmap")
        elif isinstance(item, EventRecord):
            if watch.memory is not None:
                watch.memory.relieve(lambda: nullcontext(run.map))
            if step.outcome != item.event:
                told = f"its event {item.event} came out as {step.outcome}"
                if own:
                    raise RunError(f"the log can't be followed: {told}")
                if not warned:  # the same bytes are promised within a release only
                    log.warning("the log is of another version, and the map comes out another: %s", told)
                warned = True
            result.was_reset = result.was_reset or isinstance(item.event, ResetEvent)
    return end
