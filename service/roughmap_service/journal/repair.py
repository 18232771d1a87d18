"""Repairing log files that were torn by a kill or damaged, before the run goes on."""

import contextlib
import itertools
import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mcap.records import Channel, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from roughmap_service.host.disk import create_new, sync_directory
from roughmap_service.journal.file import CHUNK_BYTES, PROFILE
from roughmap_service.journal.reader import DamagedLog, LogError, is_closed, raw_records, read_file, read_metadata
from roughmap_service.journal.records import FileStart, InputRecord

logger = logging.getLogger(__name__)

LOST_EPOCHS = 1000
"""More epochs than resets begin in practice: clients may have seen epochs that only the lost part of a log names."""


def repair(path: Path, *, damaged: bool = False) -> Path | None:
    """Rewrite a torn file up to its last whole record, with a footer; set the rest aside as ``FILE.torn``.

    Return the path of the rest, or None without one: the file was closed, or the kill came between two records. A file
    whose beginning was never written holds nothing of the run, and is set aside as a whole. The new file is on the disk
    before it takes the old one's name, so that a kill meanwhile leaves one or the other. With ``damaged``, a closed
    file is rewritten too.
    """
    if is_closed(path) and not damaged:
        return None
    torn = _unused_name(path, "torn")
    with _temporary(path, "part") as whole, _temporary(path, "rest") as copy:
        with create_new(whole) as stream:
            writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE, enable_data_crcs=True)
            writer.start(profile=PROFILE)
            end = _copy(path, writer)
            writer.finish()
            stream.flush()
            os.fsync(stream.fileno())
        over = not end or path.stat().st_size > end
        if not end:
            path.rename(torn)
        else:
            if over:
                with path.open("rb") as source, create_new(copy) as rest:
                    source.seek(end)
                    shutil.copyfileobj(source, rest)
                    rest.flush()
                    os.fsync(rest.fileno())
                copy.rename(torn)
            whole.rename(path)
    sync_directory(path.parent)
    lost = f"the rest is in {torn.name}" if over else "nothing is lost"
    cause = "is damaged" if damaged else "had no footer"
    logger.warning("%s %s: its first %s bytes are kept, %s", path.name, cause, end, lost)
    return torn if over else None


def end_at_damage(damage: DamagedLog) -> None:
    """End a run before the damage in one of its files: the records after it have lost those before them.

    The damaged file keeps the whole records before the damage; its rest (``.torn``) and the files after it
    (``.behind``) are set aside. The files after it stay if the next one begins with the record that follows: then
    nothing of the run is missing. DamagedLog again if nothing of the run would be left.
    """
    path = damage.path
    prefix = path.name.rpartition("-")[0]
    files = sorted(path.parent.glob(f"{prefix}-*.mcap"))  # names sort as files were written
    behind = files[files.index(path) + 1 :]
    try:
        read_metadata(path)
    except LogError:
        if path == files[0]:
            raise
        _record_lost_epochs(files, prefix)
        set_aside(behind)
        path.rename(_unused_name(path, "torn"))
        sync_directory(path.parent)
        return
    _record_lost_epochs(files, prefix)
    if not (behind and _follows_on(path, behind[0])):
        set_aside(behind)
    repair(path, damaged=True)


def _record_lost_epochs(files: list[Path], prefix: str) -> None:
    """Record an epoch larger than any in the run's files, as the name of an empty file.

    It stays on the disk, since this start may end before it has begun a log file.
    """
    epoch = LOST_EPOCHS
    for file in files:
        with contextlib.suppress(LogError):
            epoch = max(epoch, read_metadata(file).epoch + LOST_EPOCHS)
    files[0].with_name(f"{prefix}.epoch-{epoch}").touch()
    sync_directory(files[0].parent)


def least_epoch(directory: Path, run: str | None) -> int:
    """Return the least epoch with which a run that lost a part may go on; 0 if it lost nothing."""
    noted = (path.name.rpartition("-")[2] for path in directory.glob(f"roughmap-{run}.epoch-*"))
    return max((int(epoch) for epoch in noted if epoch.isdecimal()), default=0)


def set_aside(files: list[Path]) -> None:
    """Set aside, as ``FILE.behind``, files that lie behind a damage or a gap."""
    for file in reversed(files):  # a kill meanwhile leaves no gap
        aside = file.rename(_unused_name(file, "behind"))
        logger.error("%s follows a damaged or missing part of the run; it was set aside as %s", file.name, aside.name)
    if files:
        sync_directory(files[0].parent)


@contextmanager
def _temporary(path: Path, kind: str) -> Iterator[Path]:
    """Give a name for a file that is to be renamed once it is complete, and remove it otherwise.

    A full disk must not stay full of failed tries.
    """
    made = path.with_name(f"{path.name}.{kind}")
    try:
        yield made
    finally:
        made.unlink(missing_ok=True)


def _unused_name(path: Path, kind: str) -> Path:
    """Return a name for what is set aside of a file that no earlier repair of the same file has taken."""
    names = (path.with_name(f"{path.name}.{kind}{f'.{n}' if n else ''}") for n in itertools.count())
    return next(name for name in names if not name.exists())


def _follows_on(damaged: Path, behind: Path) -> bool:
    """Return whether the file after a damaged one begins with the record after its last whole record."""
    try:
        first, after = read_metadata(damaged), read_metadata(behind)
    except LogError:
        return False
    number, position = first.first_input - 1, first.first_record - 1
    with contextlib.suppress(DamagedLog):
        for item in read_file(damaged):
            if not isinstance(item, FileStart):
                position = item.record
            if isinstance(item, InputRecord):
                number = item.number
    return (after.first_input, after.first_record) == (number + 1, position + 1)


def _copy(path: Path, writer: Writer) -> int:
    """Copy the whole records; return where they end in bytes, 0 if not even the metadata is whole."""
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    end, begun = 0, False
    try:
        for record, behind in raw_records(path):
            if isinstance(record, Metadata):
                writer.add_metadata(record.name, record.metadata)
                begun = True
            elif isinstance(record, Schema):
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel):
                channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
                )
            elif isinstance(record, Message):
                writer.add_message(
                    channels[record.channel_id], record.log_time, record.data, record.publish_time, record.sequence
                )
            end = behind
    except (LogError, KeyError):  # KeyError: a channel or schema without its own record
        pass  # a kill tears only the end; after a power cut the end may hold anything
    return end if begun else 0
