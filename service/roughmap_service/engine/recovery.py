"""Recovery at a start: rebuilds the run from the store and the log."""

import contextlib
import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from roughmap import STATE_VERSION
from roughmap_schemas import Config, ResetEvent
from roughmap_schemas.faults import ReportedError
from roughmap_service.engine.newest_run import check_identity, goes_on, newest_run
from roughmap_service.journal.file import FILE_NAME
from roughmap_service.journal.reader import DamagedLog, LogError, last_log_time, read_metadata
from roughmap_service.journal.records import EventRecord, FileStart, LogItem
from roughmap_service.journal.repair import end_at_damage, least_epoch, set_aside
from roughmap_service.journal.run_files import RunFile, read_run
from roughmap_service.run.fold import fold
from roughmap_service.run.run import Run, RunError
from roughmap_service.run.settings import Settings, new_map
from roughmap_service.store.map_db import Cut, DamagedStore, OtherStateVersion, Store, StoreError
from roughmap_service.store.memory_limit import MemoryLimit
from roughmap_service.store.snapshots import take_cut
from roughmap_service.store.stored_tiles import StoredTiles, set_index

logger = logging.getLogger(__name__)


class OtherLogState(ReportedError):
    """The log is of another state version. One line that says how to make a map from it."""

    exit_code = 2


class Stopped(Exception):
    """The service was asked to stop while it recovered the map."""


@dataclass
class Recovered:
    """The state from which a run continues.

    Attributes:
        run: the run, with all that the log holds; its undecided clouds wait for `Run.resume`.
        run_id: None for a new run.
        index: of the run's next log file.
        epoch: the epoch of this start.
        cut: the store's, if there is one.
        was_reset: whether the map was emptied since that cut.
        not_before_ns: the next log file's ``created_ns`` must be at least this, so that this run is the newest in its
            folder even if the clock was set back.
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
"""Called with the number of log files that are done, and of all log files."""


def recover(
    config: Config,
    directory: Path,
    store: Store | None,
    progress: Progress | None = None,
    stop: threading.Event | None = None,
    memory: MemoryLimit | None = None,
) -> Recovered:
    """Recover the log directory's newest run, from the store's cut if there is one, else from its beginning.

    With ``memory`` the store's tiles stay there until they are needed, and tiles leave memory at its limit. A damaged
    log ends before the damage. A damaged store is rebuilt if the log reaches back to the run's beginning. Damaged files
    are logged and set aside. Raises LogError, StoreError, RunError, OtherLogState or IdentityError, each one line, if
    the map can't be recovered; Stopped once ``stop`` is set.
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
            logger.error("%s; the run goes on from the records before it", damage)
            end_at_damage(damage)
        except DamagedStore as damage:
            if store is None or not set_aside_damaged(store, directory, str(damage)):
                raise
            if memory is not None:
                memory.spill.failure, memory.spill.store_damaged = "", False


def set_aside_damaged(store: Store, directory: Path, damage: str) -> bool:
    """Set a damaged store aside, so that the next start rebuilds the map; False if the log lacks the beginning."""
    files = newest_run(directory, None)
    if not files or files[0].metadata.first_record > 1:
        return False
    logger.error("%s; it was renamed to %s, and the map is rebuilt from the log", damage, store.set_aside_damaged())
    return True


def _recover(config: Config, directory: Path, store: Store | None, watch: "_Watch") -> Recovered:
    outdated: OtherStateVersion | None = None
    cut: Cut | None = None
    if store is not None:
        try:
            cut = store.read_cut()
        except OtherStateVersion as error:
            outdated = error
    files = newest_run(directory, cut)
    if files and files[-1].metadata.state_version != STATE_VERSION:
        raise OtherLogState(_other_state(config, files[-1], store if outdated else None))
    if files:
        check_identity(config, files[-1].metadata.configuration, files[-1].path)
        if outdated:
            logger.warning("%s; the map is rebuilt from the log", outdated)
    elif outdated:
        raise LogError(f"{outdated}, and there is no log in {directory} to rebuild the map from; start with --fresh")
    result, end = _bring_back(config, store, cut, files, watch)
    if cut is not None and files and end < cut.record:
        result.run.map.reset()  # releases what it holds outside memory
        result = _where_the_store_is_ahead(config, store, cut, files, end, watch)
    if outdated and store is not None:
        store.set_aside("outdated")
    return result


def _other_state(config: Config, file: RunFile, store: Store | None) -> str:
    """Return what to do with a log of another state version, and with its ``store``."""
    folder, found = file.path.parent, file.metadata.state_version
    what = f"{folder} and {store.path} are" if store is not None else f"{folder} is"
    there = "" if config.map.surface == "all" else f" --what-if map.surface={config.map.surface}"
    return (
        f"{what} of state version {found} ({file.path.name}), and this release continues only version "
        f"{STATE_VERSION}: `roughmap replay {folder} -o map-{STATE_VERSION}.db{there}` builds a map from that log;"
        " serve it as store.path, with another log.directory, or begin a new map with --fresh"
    )


def _where_the_store_is_ahead(
    config: Config, store: Store | None, cut: Cut, files: list[RunFile], end: int, watch: "_Watch"
) -> Recovered:
    """Recover from a log that ends before the store's cut.

    The map is rebuilt from the log if the log reaches back to the run's beginning. Otherwise, if the log was damaged,
    the map is the store's and the log begins again. LogError if files are missing: they can be restored.
    """
    text, first = f"the log ends at record {end}, the store's cut is at {cut.record}", files[0]
    if first.metadata.first_record == 1:
        logger.warning("%s; the map is rebuilt from the log alone", text)
        result, _ = _bring_back(config, store, None, files, watch)
    elif not watch.damaged:
        raise LogError(
            f"{text}, and {first.path.name} begins at record {first.metadata.first_record}; "
            "restore the missing files, or start with --fresh"
        )
    else:
        logger.error("%s, and the log's beginning is missing; the map is the store's", text)
        set_aside([file.path for file in files])
        result, _ = _bring_back(config, store, cut, [], watch)
        result.index = files[-1].metadata.index + 1
    result.epoch = max(result.epoch, cut.epoch + 1, files[-1].metadata.epoch + 1)
    return result


@dataclass(frozen=True, slots=True)
class _Watch:
    """Where a recovery reports progress, and what limits it; ``damaged``: the log was cut off at damage."""

    progress: Progress | None
    stop: threading.Event
    memory: MemoryLimit | None
    damaged: bool


def _bring_back(
    config: Config, store: Store | None, cut: Cut | None, files: list[RunFile], watch: _Watch
) -> tuple[Recovered, int]:
    """Return the run at the end of its files, begun at the cut if there is one, and the files' last record."""
    result = blank(config, watch.memory)
    result.cut = cut
    try:
        return result, _fill(result, config, store, files, watch)
    except BaseException:
        result.run.map.reset()  # releases what it holds outside memory
        raise


def _fill(result: Recovered, config: Config, store: Store | None, files: list[RunFile], watch: _Watch) -> int:
    """Load the cut and fold the files; return the files' last record."""
    cut = result.cut
    taken, low_water = 0, 1
    if cut is not None and store is not None:
        taken, low_water = cut.record, cut.low_water
        _take_cut(config, store, cut, result, watch.memory)
    if not files:
        return 0
    first, last = files[0].metadata, files[-1].metadata
    if not goes_on(files[0], taken, low_water):
        begun = "there is no store before it" if cut is None else f"the store ends at record {cut.record}"
        raise LogError(
            f"{files[0].path.name} begins at record {first.first_record}, input {first.first_input}, but {begun}; "
            "restore the missing files, or start with --fresh"
        )
    result.run_id, result.index, result.epoch = last.run, last.index + 1, last.epoch + 1
    times = (last_log_time(file.path) for file in reversed(files))
    result.last_ns = next(
        (time for time in times if time), 0
    )  # they rise over the run; reading a full file's footer takes 1 s
    while len(files) > 1 and files[1].metadata.first_record <= taken and files[1].metadata.first_input <= low_water:
        files = files[1:]
    end = _fold_files(result, files, taken, low_water, watch)
    result.epoch = max(result.epoch, result.run.epoch + 1)
    result.run.use(Settings(config))
    return end


def blank(config: Config, memory: MemoryLimit | None = None) -> Recovered:
    """Return the beginning of a run: an empty map at sequence 0, epoch 1."""
    rough_map = new_map(config, None if memory is None else memory.spill)
    return Recovered(Run(Settings(config), rough_map))


def begin_new_run(config: Config, directory: Path, memory: MemoryLimit | None = None) -> Recovered:
    """Return the beginning of a run that is newer than all runs in the directory."""
    result = blank(config, memory)
    for path in directory.glob("*.mcap"):
        if FILE_NAME.fullmatch(path.name):
            with contextlib.suppress(LogError, OSError):  # an unreadable file can't pass for a newer run
                result.not_before_ns = max(result.not_before_ns, read_metadata(path).created_ns + 1)
    return result


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
        raise DamagedStore(f"{store.path}: damaged (its tiles do not have the digest that its cut names)")
    take_cut(cut, run)
    result.run_id, result.epoch = cut.run, cut.epoch + 1


def _fold_files(result: Recovered, files: list[RunFile], taken: int, low_water: int, watch: _Watch) -> int:
    """Fold the files into the run; return their last record."""
    run = result.run
    done = 0
    end = files[0].metadata.first_record - 1  # if the files hold no record
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
                text = f"its event {item.event} came out as {step.outcome}"
                if own:
                    raise RunError(f"the log can't be replayed: {text}")
                if not warned:  # equal maps are promised within a release only
                    logger.warning("the log is of another version, and the map comes out different: %s", text)
                warned = True
            result.was_reset = result.was_reset or isinstance(item.event, ResetEvent)
    return end
