"""Making a file that a kill left without its footer a whole one, before the run goes on."""

import contextlib
import logging
import os
import shutil
from pathlib import Path

from mcap.records import Channel, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from .disk import made_anew, sync, sync_directory
from .log_file import CHUNK_BYTES, PROFILE
from .log_reader import (
    DamagedLog,
    FileStart,
    InputRecord,
    LogError,
    is_closed,
    raw_records,
    read_file,
    read_metadata,
)

log = logging.getLogger(__name__)


def repair(path: Path, *, damaged: bool = False) -> Path | None:
    """Rewrite a torn file up to its last whole record, with a footer; the torn rest is kept as ``FILE.torn``.

    Returns that file's path, or None if there is no rest: the file was closed, or the kill came between two records. A
    file whose beginning was never written holds nothing of the run and becomes the ``.torn`` as a whole. The new file
    is on the disk before it takes the old one's name, so that a kill in here leaves the one or the other; a closed file
    is on the disk behind this, too. With ``damaged`` a closed file is rewritten as well.
    """
    if is_closed(path) and not damaged:
        sync(path)  # the kill may have come between the footer and its fsync; what follows must not outlive it
        return None
    torn = path.with_name(path.name + ".torn")
    whole = path.with_name(path.name + ".part")
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
        whole.unlink()
    else:
        if over:
            with path.open("rb") as source, made_anew(torn) as rest:
                source.seek(end)
                shutil.copyfileobj(source, rest)
                rest.flush()
                os.fsync(rest.fileno())
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
    files = sorted(path.parent.glob(path.name.rpartition("-")[0] + "-*.mcap"))  # names sort as files were written
    behind = files[files.index(path) + 1 :]
    try:
        read_metadata(path)
    except LogError:
        if path == files[0]:
            raise
        _put_behind(behind)
        path.rename(path.with_name(path.name + ".torn"))
        sync_directory(path.parent)
        return
    if not (behind and _lacks_nothing(path, behind[0])):
        _put_behind(behind)
    repair(path, damaged=True)


def _put_behind(files: list[Path]) -> None:
    for file in reversed(files):  # a kill in here leaves no gap
        file.rename(file.with_name(file.name + ".behind"))
        log.error("%s lies behind a damage, and is %s.behind now", file.name, file.name)


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
