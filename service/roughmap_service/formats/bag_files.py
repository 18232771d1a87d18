"""Files of rosbag2 (folders, .mcap, .db3; zstd too) and of ROS 1 (.bag): their topics, and their messages as CDR."""

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2

from roughmap_ros.messages import TYPES
from roughmap_service.formats.damage import damage
from roughmap_service.formats.recorded import CloudFileFault
from roughmap_service.formats.robot_messages import Raw
from roughmap_service.formats.topics import Topic, absolute, role_of
from roughmap_service.formats.unpacking import MAX_CHUNK, bound_rosbags

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

bound_rosbags()


class Bag:
    """An open bag. `topics` are those of the types that roughmap reads; `start_ns` and `end_ns` span all messages."""

    def __init__(self, path: Path, reader: Reader1 | Reader2) -> None:
        self.path = path
        self._reader = reader
        self._readers: dict[str, list[Connection]] = {}
        counts: dict[str, Topic] = {}
        for connection in reader.connections:
            name = absolute(connection.topic)
            role = role_of(connection.msgtype, name)
            if role is None:
                continue
            self._readers.setdefault(name, []).append(connection)
            before = counts[name].messages if name in counts else 0
            counts[name] = Topic(name, role, before + connection.msgcount)
        formats = {one.msgdef.format for one in reader.connections}
        self.typed = MessageDefinitionFormat.NONE not in formats
        self.topics = sorted(counts.values())
        self.start_ns, self.end_ns = (reader.start_time, reader.end_time) if reader.message_count else (0, 0)

    def messages(self, topics: Collection[str], until_ns: int | None = None) -> Iterator[Raw]:
        """Return the messages of some topics in the order in which they were recorded. Raises CloudFileFault."""
        connections = [one for name in topics for one in self._readers.get(name, ())]
        if not connections:
            return
        last_ns = self.start_ns
        found: Iterator[Any] = self._reader.messages(connections, stop=until_ns)
        while True:
            try:
                one, log_ns, data = next(found)
            except StopIteration:
                return
            except Exception as error:  # rosbags and what unpacks raise almost anything for bad bytes
                raise fault(self.path, error, f" after {(last_ns - self.start_ns) / 1e9:.1f} s") from error
            last_ns = log_ns
            yield Raw(absolute(one.topic), self._cdr(one.msgtype, data), log_ns)

    def _cdr(self, msgtype: str, data: bytes) -> bytes:
        """Return a message as CDR; the bytes as they are if they are not of its type: whoever reads them says so."""
        if isinstance(self._reader, Reader2):
            return data
        try:
            return bytes(TYPES.ros1_to_cdr(data, msgtype))
        except Exception:  # noqa: BLE001 - rosbags raises almost anything for bad bytes
            return b""


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag. Raises CloudFileFault, or OSError if its files can't be read."""
    reader: Reader1 | Reader2
    try:
        reader = Reader1(path) if path.suffix.lower() == ".bag" and path.is_file() else Reader2(path)
        reader.open()
        bag = Bag(path, reader)
        check_chunks(path, _chunk_sizes(reader))
    except (PermissionError, CloudFileFault):
        raise
    except Exception as error:  # rosbags and what unpacks raise almost anything for bad bytes
        raise fault(path, error) from error
    try:
        yield bag
    finally:
        reader.close()


def _chunk_sizes(reader: Reader1 | Reader2) -> list[int]:
    storage = getattr(reader, "storage", None)
    files = getattr(storage, "storages", [storage])
    return [chunk.uncompressed_size for file in files for chunk in getattr(file, "chunks", ())]


def check_chunks(path: Path, sizes: Sequence[int]) -> None:
    """Raise CloudFileFault if one of an MCAP file's chunks of these sizes, in bytes, is too large to unpack."""
    largest = max(sizes, default=0)
    if largest > MAX_CHUNK:
        raise CloudFileFault(f"{path}: expected chunks of at most {MAX_CHUNK} bytes, found one of {largest}")


def fault(path: Path, error: Exception, where: str = "") -> CloudFileFault:
    """Return the fault of a bag that can't be read: where it is damaged, and what may mend it."""
    text = " ".join(str(error).split()).rstrip(".") or type(error).__name__
    found = damage(path)
    if found is None:
        return CloudFileFault(f"{path}: can't be read{where}: {text}")
    return CloudFileFault(f"{found.file}: damaged at offset {found.offset}{where}: {text}; {found.remedy}")
