"""Finds the log files from which a start continues: the newest run's, repaired, complete and of this map."""

import logging
from pathlib import Path

from roughmap_schemas import Config, configuration_digest
from roughmap_schemas.faults import ReportedError
from roughmap_service.host.disk import sync
from roughmap_service.journal.file import FILE_NAME
from roughmap_service.journal.reader import DamagedLog, has_summary, is_closed
from roughmap_service.journal.repair import repair
from roughmap_service.journal.run_files import RunFile, find_files, one_run
from roughmap_service.store.map_db import Cut, StoreError

logger = logging.getLogger(__name__)


class IdentityError(ReportedError):
    """The configuration describes another map than the store or the log."""

    exit_code = 2


def newest_run(directory: Path, cut: Cut | None) -> list[RunFile]:
    """Return the files of the newest run in a directory, which must be the cut's run if there is a cut.

    Files that a kill left torn are repaired first. Unreadable files that the cut does not need are left out; DamagedLog
    if it needs one.
    """
    ours = [path for path in sorted(directory.glob("*.mcap")) if FILE_NAME.fullmatch(path.name)]
    files: list[RunFile] = []
    unreadable: list[DamagedLog] = []
    last = {path.name.rpartition("-")[0]: path for path in ours}.values()  # of each run
    for path in ours:  # other files must not be changed
        # A power cut may have come while the footer was written.
        repair(path, damaged=path in last and is_closed(path) and not has_summary(path))
        if path.exists():  # the repair sets aside a file without content
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
            f"the store is of run {cut.run[:8]}, the newest log of run {newest[:8]}; move one of them away "
            "or start with --fresh"
        )
    files = [file for file in files if file.metadata.run == newest]
    for fault in unreadable:
        if newest not in fault.path.name:
            continue
        files = [file for file in files if file.path > fault.path]
        if cut is None or not files or not goes_on(files[0], cut.record, cut.low_water):
            raise fault
        logger.error("%s; the store does not need this file, so the start goes on", fault)
    # After a kill between footer and fsync the last file may not be on the disk; what follows must not outlive it.
    sync(files[-1].path)
    return one_run(files)


def goes_on(file: RunFile, taken: int, low_water: int) -> bool:
    """Return whether no record is missing between a cut and the file's beginning."""
    return file.metadata.first_record <= taken + 1 and file.metadata.first_input <= low_water


def check_identity(config: Config, stored: dict[str, object], where: Path) -> None:
    """Raise IdentityError, with both values, for the first setting that would make a different map."""
    try:
        there = Config.from_log(stored)
    except ValueError as error:
        raise IdentityError(
            f"{where}: can't read its configuration, which is of another version ({str(error).splitlines()[0]}); "
            "start with --fresh"
        ) from None
    if configuration_digest(there) == configuration_digest(config):
        return
    old, new = there.identity(), config.identity()
    for name in {**new, **old}:  # a limit that is not among them is infinite
        value, stands = new.get(name, "inf"), old.get(name, "inf")
        if value != stands:
            raise IdentityError(
                f"map.{name} is {value!r} in the configuration but {stands!r} in {where}; "
                "set it back, or begin a new run with --fresh"
            )
