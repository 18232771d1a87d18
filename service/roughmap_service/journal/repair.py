"""Making a file that a kill left without its footer a whole one, before the run goes on."""

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

from roughmap_service.host.disk import made_anew, sync_directory
from roughmap_service.journal.file import CHUNK_BYTES, PROFILE
from roughmap_service.journal.reader import DamagedLog, LogError, is_closed, raw_records, read_file, read_metadata
from roughmap_service.journal.records import FileStart, InputRecord

log = logging.getLogger(__name__)

LOST_EPOCHS = 1000
"""Epochs that may have been told of in what lies behind a damage and can't be read: more than anybody resets."""


def repair(path: Path, *, damaged: bool = False) -> Path | None:
    """Rewrite a torn file up to its last whole record, with a footer; the torn rest is kept as ``FILE.torn``.

    Returns that file's path, or None if there is no rest: the file was closed, or the kill came between two records. A
    file whose beginning was never written holds nothing of the run and becomes the ``.torn`` as a whole. The new file
    is on the disk before it takes the old one's name, so that a kill in here leaves the one or the other. With
    ``damaged`` a closed file is rewritten too.
    """
    if is_closed(path) and not damaged:
        return None
    torn = _beside(path, "torn")
    with _made_beside(path, "part") as whole, _made_beside(path, "rest") as copy:
        with made_anew(whole) as stream:
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
                with path.open("rb") as source, made_anew(copy) as rest:
                    source.seek(end)
                    shutil.copyfileobj(source, rest)
                    rest.flush()
                    os.fsync(rest.fileno())
                copy.rename(torn)
            whole.rename(path)
    sync_directory(path.parent)
    where = f"the rest is in {torn.name}" if over else "nothing was torn"
    what = "is damaged" if damaged else "had no footer"
    log.warning("%s %s: %s whole bytes kept, %s", path.name, what, end, where)
    return torn if over else None


def end_at_damage(damage: DamagedLog) -> None:
    """Make a run end before a damage in one of its files: nothing behind it can be placed as it was.

    The damaged file keeps what is whole before the damage; the rest of it, and the files behind it, stay beside it
    under other names (``.torn``, ``.behind``). Where the next file begins with what follows, nothing of the run is
    missing, and it goes on there. DamagedLog again if nothing of the run would be left.
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
        _note_lost(files, prefix)
        set_aside(behind)
        path.rename(_beside(path, "torn"))
        sync_directory(path.parent)
        return
    _note_lost(files, prefix)
    if not (behind and _lacks_nothing(path, behind[0])):
        set_aside(behind)
    repair(path, damaged=True)


def _note_lost(files: list[Path], prefix: str) -> None:
    """Note, as a file's name, an epoch that is larger than all that were told of in a run's files. It stays, since the
    start that ends the run here may itself end before it has begun a file of its own."""
    epoch = LOST_EPOCHS
    for file in files:
        with contextlib.suppress(LogError):
            epoch = max(epoch, read_metadata(file).epoch + LOST_EPOCHS)
    files[0].with_name(f"{prefix}.epoch-{epoch}").touch()
    sync_directory(files[0].parent)


def least_epoch(directory: Path, run: str | None) -> int:
    """The least epoch with which a run may go on, of which a part was lost; 0 if none was."""
    noted = (path.name.rpartition("-")[2] for path in directory.glob(f"roughmap-{run}.epoch-*"))
    return max((int(epoch) for epoch in noted if epoch.isdecimal()), default=0)


def set_aside(files: list[Path]) -> None:
    """Put files that nothing can be made of beside the log, as ``FILE.behind``."""
    for file in reversed(files):  # a kill in here leaves no gap
        kept = file.rename(_beside(file, "behind"))
        log.error("%s can't be placed in the run, and is %s now", file.name, kept.name)
    if files:
        sync_directory(files[0].parent)


@contextmanager
def _made_beside(path: Path, kind: str) -> Iterator[Path]:
    """A name for what is made of a file and gets another name when it is whole. Else it goes, whatever failed: a disk
    that is full must not be full of tries."""
    made = path.with_name(f"{path.name}.{kind}")
    try:
        yield made
    finally:
        made.unlink(missing_ok=True)


def _beside(path: Path, kind: str) -> Path:
    """A name for what is kept of a file, which no earlier repair has taken: a run may come to the same file again."""
    names = (path.with_name(f"{path.name}.{kind}{f'.{n}' if n else ''}") for n in itertools.count())
    return next(name for name in names if not name.exists())


def _lacks_nothing(damaged: Path, behind: Path) -> bool:
    """Whether a damaged file's last whole record of the run is the one before those of the file behind it."""
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
    """Copy what is whole; returns the byte behind it, 0 if not even the metadata is there."""
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
    except (LogError, KeyError):  # KeyError: of a channel or schema that was never told
        # After a kill only the end can be torn; after a power cut it may hold anything. Either way it ends here.
        pass
    return end if begun else 0
