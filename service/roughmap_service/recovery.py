"""At start-up: from the store and the log to the map as it was, and to what was still undecided."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from roughmap_schemas import Config, ResetEvent, configuration_digest

from .apply import RunError, RunState
from .fold import fold
from .ingest import Duplicates
from .log_file import Kind
from .log_reader import EventRecord, FileStart, InputRecord, LogError, RunFile, find_files, one_run, read_run
from .log_repair import repair
from .settings import Settings, new_map
from .store import Cut, Store, StoreError

log = logging.getLogger(__name__)


class IdentityError(Exception):
    """The configuration names another map than the store or log holds."""


@dataclass
class Recovered:
    """Where a run goes on. ``undecided`` are (input, robot, bytes) of clouds that wait anew; ``cut`` is the
    store's, and ``was_reset`` says that the map was emptied since that cut."""

    state: RunState
    duplicates: Duplicates
    run: str | None = None
    index: int = 0
    epoch: int = 1
    cut: Cut | None = None
    undecided: list[tuple[int, str, int]] = field(default_factory=list)
    was_reset: bool = False


Progress = Callable[[int, int], None]
"""Told how many of how many log files are folded."""


def recover(config: Config, directory: Path, store: Store | None, progress: Progress | None = None) -> Recovered:
    """Bring back the log directory's newest run, from the store's cut if there is one, else from its beginning.

    LogError, StoreError, RunError or IdentityError, each one line, where the map can't be had again.
    """
    result = blank(config)
    state = result.state
    result.cut = cut = store.read_cut() if store is not None else None
    files = newest_run(directory, None if cut is None else cut.run)
    if cut is not None and store is not None:
        _take_cut(config, store, cut, result)
    if not files:
        return result
    check_identity(config, files[-1].metadata.configuration, files[-1].path)
    last = files[-1].metadata
    result.run, result.index, result.epoch = last.run, last.index + 1, last.epoch + 1
    taken = 0 if cut is None else cut.record
    low_water = 1 if cut is None else cut.low_water
    if cut is None and (files[0].metadata.base_sequence or files[0].metadata.index):
        raise LogError(
            f"{files[0].path.name} begins at sequence {files[0].metadata.base_sequence}, and there is no store to "
            "begin from; bring back the store or the first files, or start with --fresh"
        )
    while len(files) > 1 and files[1].metadata.first_record <= taken and files[1].metadata.first_input <= low_water:
        files = files[1:]
    _fold_files(result, files, taken, low_water, progress)
    result.epoch = max(result.epoch, state.epoch + 1)
    state.use(Settings(config))
    if state.record < taken:
        log.warning("the log ends at record %d, before the store's cut; going on from the store", state.record)
    return result


def blank(config: Config) -> Recovered:
    """The beginning of a run: an empty map at sequence 0, epoch 1."""
    return Recovered(RunState(Settings(config), new_map(config)), Duplicates(config.input.duplicates))


def newest_run(directory: Path, run: str | None) -> list[RunFile]:
    """The files of ``run``, or of the newest run there; files that a kill left torn are repaired first."""
    for path in sorted(directory.glob("roughmap-*.mcap")):  # a foreign file is not ours to change
        repair(path)
    files = find_files([directory])
    if not files:
        return []
    newest = max(files, key=lambda file: file.metadata.created_ns).metadata.run
    if run is not None and run != newest:
        raise StoreError(
            f"the store is of run {run[:8]}, the newest log of run {newest[:8]}; move one of them away, "
            "or start with --fresh"
        )
    return one_run([file for file in files if file.metadata.run == newest])


def check_identity(config: Config, stored: dict[str, object], where: Path) -> None:
    """IdentityError that names both values of the first setting that would make it another map."""
    there = Config.model_validate(stored)
    if configuration_digest(there) == configuration_digest(config):
        return
    old, new = there.identity(), config.identity()
    for name, value in new.items():
        if old.get(name) != value:
            raise IdentityError(
                f"map.{name} is {value!r} in the configuration but {old.get(name)!r} in {where}; "
                "set it back, or begin a new run with --fresh"
            )


def _take_cut(config: Config, store: Store, cut: Cut, result: Recovered) -> None:
    check_identity(config, cut.configuration, store.path)
    state = result.state
    store.load_into(state.map, cut)
    state.epoch, state.input, state.record = cut.epoch, cut.input, cut.record
    for robot, buffer in cut.poses.items():
        state.buffer(robot).load_state(buffer)
    result.duplicates.load_state(cut.duplicates)
    result.run, result.epoch = cut.run, cut.epoch + 1


def _fold_files(result: Recovered, files: list[RunFile], taken: int, low_water: int, progress: Progress | None) -> None:
    state = result.state
    waiting: dict[int, tuple[str, int]] = {}
    done = 0
    for step in fold(state, read_run(files), taken=taken, low_water=low_water):
        item = step.item
        if isinstance(item, FileStart):
            if progress is not None:
                progress(done, len(files))
            done += 1
        elif isinstance(item, InputRecord):
            if item.kind is Kind.POINTS:
                waiting[item.number] = item.robot, len(item.payload)
            if item.record > taken:
                identity = Duplicates.identity(item.robot, item.kind, item.payload)
                result.duplicates.add(identity, item.number)
        elif isinstance(item, EventRecord) and step.outcome != item.event:
            raise RunError(f"the log can't be followed: its event {item.event} came out as {step.outcome}")
        elif isinstance(step.outcome, ResetEvent):
            result.was_reset = True
    result.undecided = [(number, *waiting[number]) for number in sorted(state.clouds)]
