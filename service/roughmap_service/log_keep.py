"""Deleting the log's oldest files, where the configuration bounds what is kept."""

import logging
from pathlib import Path

from .disk import sync_directory
from .log_reader import LogError, read_metadata
from .store import Cut

log = logging.getLogger(__name__)


def delete_oldest(directory: Path, cut: Cut, keep: int) -> list[Path]:
    """Delete whole closed files of the cut's run, oldest first, until those left hold at most ``keep`` bytes.

    The committed snapshot of ``cut`` needs what lies after its record, and its undecided clouds; a file with any of
    that stays, and so do the file that is written to now and all files of other runs. Returns what was deleted.
    OSError from the disk.
    """
    files = sorted(directory.glob(f"roughmap-{cut.run}-*.mcap"))
    sizes = [file.stat().st_size for file in files[:-1]]
    deleted: list[Path] = []
    for file, after, size in zip(files, files[1:], sizes, strict=False):
        if sum(sizes[len(deleted) :]) <= keep or not _spares(after, cut):
            break
        file.unlink()
        deleted.append(file)
        log.info("%s (%d bytes) was deleted: log.keep is %d", file.name, size, keep)
    if deleted:
        sync_directory(directory)
    return deleted


def _spares(after: Path, cut: Cut) -> bool:
    """Whether all that the cut needs lies in the file ``after`` or behind it."""
    try:
        first = read_metadata(after)
    except LogError:
        return False
    return first.first_record <= cut.record + 1 and first.first_input <= cut.low_water
