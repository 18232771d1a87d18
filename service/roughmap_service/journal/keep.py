"""Deleting the log's oldest files when `log.keep` bounds its size."""

import logging
import re
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from roughmap_service.host.disk import sync_directory
from roughmap_service.journal.file import FILE_NAME
from roughmap_service.journal.reader import LogError, read_metadata

logger = logging.getLogger(__name__)

LOG_FILES = re.compile(rf"({FILE_NAME.pattern})(\.(torn|behind)(\.\d+)?)?")
"""Names of log files, and of what `journal/repair.py` set aside."""


@dataclass(frozen=True, slots=True)
class Needed:
    """What the stored snapshot needs of its run's log.

    These are all records after ``record``, and all clouds from input ``low_water`` on.
    """

    run: str
    record: int
    low_water: int


def delete_oldest(current: Path, needed: Needed, keep: int) -> list[Path]:
    """Delete whole log files beside ``current``, the present one, until all together have at most ``keep`` bytes.

    The oldest run goes first and the snapshot's run last; the files of a run go in the order they were written, each
    followed by what was set aside of it. Deleting stops at the first file with anything ``needed``. Return the deleted
    paths. OSError from the disk.
    """
    runs: dict[str, list[Path]] = {}
    for path in sorted(current.parent.iterdir()):
        if match := LOG_FILES.fullmatch(path.name):
            runs.setdefault(match["run"], []).append(path)
    sizes = {path: path.stat().st_size for path in chain(*runs.values())}
    excess = sum(sizes.values()) - keep
    deleted: list[Path] = []
    if excess <= 0:
        return deleted
    own = runs.pop(needed.run, [])
    for path in chain(*sorted(runs.values(), key=_began_ns), own):
        if excess <= 0 or path == current or (path in own and not _is_spare(path, own, needed)):
            break
        path.unlink()
        excess -= sizes[path]
        deleted.append(path)
        logger.info("%s (%d bytes) was deleted: log.keep is %d bytes", path.name, sizes[path], keep)
    if deleted:
        sync_directory(current.parent)
    return deleted


def _began_ns(files: list[Path]) -> int:
    """Return when a run began, in ns, from its first file or else its modification time. Run names are random."""
    try:
        return read_metadata(files[0]).created_ns
    except (LogError, OSError):
        return files[0].stat().st_mtime_ns


def _is_spare(path: Path, own: list[Path], needed: Needed) -> bool:
    """Return whether everything needed lies behind the file ``path`` of its run."""
    if path.suffix != ".mcap":
        return True
    after = next((file for file in own if file > path and file.suffix == ".mcap"), None)
    try:
        first = None if after is None else read_metadata(after)
    except LogError:
        return False
    return first is not None and first.first_record <= needed.record + 1 and first.first_input <= needed.low_water
