"""MCAP files: bags of ROS 2, roughmap's own logs, and recordings of Foxglove's messages (protobuf or JSON).

Of Foxglove's, PointCloud, Odometry, PoseInFrame, FrameTransform and FrameTransforms are read. ROS messages among them
are read too.
"""

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from mcap.reader import SeekingReader

from roughmap_ros.messages import TYPES
from roughmap_service.formats.bag_files import check_chunks, fault
from roughmap_service.formats.bags import read_bag
from roughmap_service.formats.foxglove import to_cdr
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.own_logs import is_own_log, read_own_log
from roughmap_service.formats.posed_clouds import messages_of
from roughmap_service.formats.recorded import Recorded
from roughmap_service.formats.robot_messages import Raw
from roughmap_service.formats.topics import Role, Topic, absolute, role_of

if TYPE_CHECKING:
    from mcap.records import Channel, Schema
    from mcap.summary import Summary


def read_mcap(path: Path, options: ReadOptions) -> Iterator[Recorded]:
    """Return a robot's messages in the order in which they were recorded. Raises CloudFileFault and OSError."""
    with path.open("rb") as stream:
        try:
            reader = SeekingReader(stream, validate_crcs=True)
            profile, summary = reader.get_header().profile, reader.get_summary()
            own = is_own_log(reader)
        except Exception as error:  # the library raises almost anything for bad bytes
            raise fault(path, error) from error
        if summary is None or summary.statistics is None:
            raise fault(path, ValueError(f"no index at its end; `mcap recover {path} -o mended.mcap` makes one"))
        check_chunks(path, [one.uncompressed_size for one in summary.chunk_indexes])
        if own:
            yield from read_own_log(path, reader, summary, options)
        elif profile == "ros2":
            yield from read_bag(path, options)
        else:
            yield from messages_of(McapFile(path, stream, summary), options)


class McapFile:
    """An open MCAP file; a `Source`."""

    def __init__(self, path: Path, stream: BinaryIO, summary: "Summary") -> None:
        self.path = path
        self.typed = True
        self._stream = stream
        self._known: dict[str, Topic] = {}
        statistics = summary.statistics
        assert statistics is not None  # noqa: S101 - the caller has looked
        for channel in summary.channels.values():
            role = _role(channel, summary.schemas.get(channel.schema_id))
            if role is not None:
                before = self._known[channel.topic].messages if channel.topic in self._known else 0
                number = before + statistics.channel_message_counts.get(channel.id, 0)
                self._known[channel.topic] = Topic(channel.topic, role, number)
        self._names = {absolute(name): name for name in self._known}
        self.topics = sorted(topic._replace(name=absolute(name)) for name, topic in self._known.items())
        self.start_ns, self.end_ns = statistics.message_start_time, statistics.message_end_time

    def messages(self, topics: Collection[str], until_ns: int | None = None) -> Iterator[Raw]:
        """Return the messages of some topics in the order in which they were recorded. Raises CloudFileFault."""
        names = [self._names[topic] for topic in topics if topic in self._names]
        if not names:
            return
        last_ns = self.start_ns
        self._stream.seek(0)
        found = SeekingReader(self._stream, validate_crcs=True).iter_messages(names, ending_before=until_ns)
        while True:
            try:
                schema, channel, message = next(found)
            except StopIteration:
                return
            except Exception as error:  # the library raises almost anything for bad bytes
                raise fault(self.path, error, f" after {(last_ns - self.start_ns) / 1e9:.1f} s") from error
            last_ns = message.log_time
            yield self._raw(channel, schema, message.data, message.log_time)

    def _raw(self, channel: "Channel", schema: "Schema | None", data: bytes, log_ns: int) -> Raw:
        topic = absolute(channel.topic)
        name = "" if schema is None else schema.name
        try:
            if channel.message_encoding == "cdr":
                return Raw(topic, data, log_ns)
            if channel.message_encoding == "ros1":
                return Raw(topic, bytes(TYPES.ros1_to_cdr(data, _ros_type(name))), log_ns)
            return Raw(topic, to_cdr(name, data, as_json=channel.message_encoding == "json"), log_ns)
        except Exception:  # noqa: BLE001 - what can't be read is empty, and refused by the one who takes it
            return Raw(topic, b"", log_ns)


def _role(channel: "Channel", schema: "Schema | None") -> Role | None:
    name = "" if schema is None else schema.name
    if channel.message_encoding in {"cdr", "ros1"}:
        return role_of(_ros_type(name), channel.topic)
    return role_of(name, channel.topic) if channel.message_encoding in {"protobuf", "json"} else None


def _ros_type(name: str) -> str:
    """Return a type's name as ROS 2 writes it: pkg/msg/Type for ROS 1's pkg/Type."""
    return name if "/msg/" in name else name.replace("/", "/msg/", 1)
