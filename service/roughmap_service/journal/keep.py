"""Deleting the log's oldest files, where the configuration bounds what is kept."""

import logging
import re
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from roughmap_service.host.disk import sync_directory
from roughmap_service.journal.file import FILE_NAME
from roughmap_service.journal.reader import LogError, read_metadata

log = logging.getLogger(__name__)

OURS = re.compile(rf"({FILE_NAME.pattern})(\.(torn|behind)(\.\d+)?)?")
"""Files of the log, and what a repair put beside them (`log_repair`)."""


@dataclass(frozen=True, slots=True)
class Needed:
    """What a stored snapshot still needs of its run's log: all records after ``record``, all clouds from input
    ``low_water`` on."""

    run: str
    record: int
    low_water: int


def delete_oldest(current: Path, needed: Needed, keep: int) -> list[Path]:
    """Delete whole files of ours beside ``current``, the one that is written to, until all hold at most ``keep`` bytes.

    The oldest run goes first, the snapshot's own last, each run's files in the order they were written; what a
    repair put beside a file goes after it. Deleting stops at the first file that holds anything ``needed``. Returns the
    deleted paths. OSError from the disk.
    """
    runs: dict[str, list[Path]] = {}
    for path in sorted(current.parent.iterdir()):
        if match := OURS.fullmatch(path.name):
            runs.setdefault(match["run"], []).append(path)
    sizes = {path: path.stat().st_size for path in chain(*runs.values())}
    excess = sum(sizes.values()) - keep
    deleted: list[Path] = []
    if excess <= 0:
        return deleted
    own = runs.pop(needed.run, [])
    for path in chain(*sorted(runs.values(), key=_begun), own):
        if excess <= 0 or path == current or (path in own and not _spared(path, own, needed)):
            break
        path.unlink()
        excess -= sizes[path]
        deleted.append(path)
        log.info("%s (%d bytes) was deleted: log.keep is %d", path.name, sizes[path], keep)
    if deleted:
        sync_directory(current.parent)
    return deleted


def _begun(files: list[Path]) -> int:
    """When a run began, in ns: as its first file says, or else the disk. Names don't tell: a run's is random."""
    try:
        return read_metadata(files[0]).created_ns
    except (LogError, OSError):
        return files[0].stat().st_mtime_ns


def _spared(path: Path, own: list[Path], needed: Needed) -> bool:
    """Whether all that is needed lies behind the file ``path`` of its run."""
    if path.suffix != ".mcap":
        return True
    after = next((file for file in own if file > path and file.suffix == ".mcap"), None)
    try:
        first = None if after is None else read_metadata(after)
    except LogError:
        return False
    return first is not None and first.first_record <= needed.record + 1 and first.first_input <= needed.low_water
