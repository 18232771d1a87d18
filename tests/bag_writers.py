"""A short drive as ROS messages, and bags of it: bytes by the specifications, and by mcap's own writers."""

import sqlite3
import struct
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from mcap.writer import CompressionType, Writer
from mcap_ros2.writer import Writer as Ros2Writer

T0 = 1_700_000_000_000_000_000
MOUNT = (0.25, 0.0, 1.0)
TYPES = {
    "cloud": "sensor_msgs/msg/PointCloud2",
    "odometry": "nav_msgs/msg/Odometry",
    "tf": "tf2_msgs/msg/TFMessage",
    "livox": "livox_ros_driver2/msg/CustomMsg",
    "pose_stamped": "geometry_msgs/msg/PoseStamped",
}


class Said(NamedTuple):
    """A message: its topic, its kind (of TYPES), when it was recorded and its content."""

    topic: str
    kind: str
    log_ns: int
    content: dict[str, Any]


def cloud(t: float, frame: str = "velodyne", points: int = 300) -> dict[str, Any]:
    rng = np.random.default_rng(int(t * 1000))
    xyz = np.column_stack((rng.uniform(-4, 4, (points, 2)), np.full(points, -MOUNT[2])))
    rows = np.column_stack((xyz, np.linspace(-0.09, 0.0, points))).astype("<f4")
    return {"stamp_ns": T0 + round(t * 1e9), "frame": frame, "rows": rows}


def pose(t: float, frame: str = "map") -> dict[str, Any]:
    return {"stamp_ns": T0 + round(t * 1e9), "frame": frame, "child": "base_link", "position": (0.8 * t, 0.1 * t, 0.0)}


def drive(seconds: float = 3.0, frame: str = "map", topic: str = "/velodyne_points") -> list[Said]:
    """Clouds at 10 Hz, odometry at 50 Hz, and where the sensor is; no two at one time."""
    mount = {"stamp_ns": T0, "frame": "base_link", "child": "velodyne", "position": MOUNT}
    said = [Said("/tf_static", "tf", T0 - 50_000_000, mount)]
    for k in range(round(seconds * 50) + 10):
        t = 0.02 * k - 0.15
        said.append(Said("/odom", "odometry", T0 + round(t * 1e9) + 1_000_000, pose(t, frame)))
    said += (Said(topic, "cloud", T0 + k * 100_000_000 + 7_000_000, cloud(0.1 * k)) for k in range(round(seconds * 10)))
    return sorted(said, key=lambda one: one.log_ns)


# The wire -------------------------------------------------------------------------------------------------------------


class Bytes:
    """Writes a ROS message: in CDR, whose numbers are aligned, or as ROS 1 does."""

    def __init__(self, ros1: bool) -> None:
        self.ros1, self.data = ros1, bytearray()

    def put(self, form: str, *values: float) -> None:
        for value in values:
            if not self.ros1:
                self.data += bytes(-len(self.data) % struct.calcsize(form))
            self.data += struct.pack("<" + form, value)

    def text(self, text: str) -> None:
        raw = text.encode() + (b"" if self.ros1 else b"\0")
        self.put("I", len(raw))
        self.data += raw

    def header(self, content: dict[str, Any]) -> None:
        if self.ros1:
            self.put("I", 0)
        self.put("I", *divmod(content["stamp_ns"], 10**9))
        self.text(content["frame"])

    def done(self) -> bytes:
        return bytes(self.data) if self.ros1 else b"\0\1\0\0" + bytes(self.data)


def wire(one: Said, *, ros1: bool = False) -> bytes:
    """Return a message in CDR or as ROS 1 writes it."""
    out, content = Bytes(ros1), one.content
    if one.kind == "tf":
        out.put("I", 1)
    out.header(content)
    if one.kind == "cloud":
        rows, size = content["rows"], content["rows"].itemsize
        step = size * rows.shape[1]
        out.put("I", 1, len(rows), rows.shape[1])
        for k in range(rows.shape[1]):
            out.text(("x", "y", "z", "time")[k])
            out.put("I", size * k)
            out.put("B", {4: 7, 8: 8}[size])
            out.put("I", 1)
        out.put("B", 0)
        out.put("I", step, step * len(rows), step * len(rows))
        out.data += rows.tobytes()
        out.put("B", 1)
        return out.done()
    if one.kind == "livox":
        rows = content["rows"]
        out.put("Q", content["stamp_ns"])
        out.put("I", len(rows))
        out.put("B", 1, 0, 0, 0)
        out.put("I", len(rows))
        for x, y, z, time in rows.tolist():
            out.put("I", round(time * 1e9))
            out.put("f", x, y, z)
            out.put("B", 9, 16, 3)
        return out.done()
    if one.kind != "pose_stamped":
        out.text(content["child"])
    out.put("d", *content["position"], *content.get("rotation", (0.0, 0.0, 0.0, 1.0)))
    if one.kind == "odometry":
        out.put("d", *[0.0] * (36 + 6 + 36))
    return out.done()


# Bags -----------------------------------------------------------------------------------------------------------------


def topics_of(said: Iterable[Said]) -> dict[str, str]:
    return {one.topic: TYPES[one.kind] for one in said}


def write_sqlite(folder: Path, said: Sequence[Said], pack: Callable[[bytes], bytes] | None = None) -> Path:
    """Write a rosbag2 folder with sqlite3, as of Humble."""
    folder.mkdir()
    topics = topics_of(said)
    base = sqlite3.connect(folder / "drive_0.db3")
    base.executescript(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
        "serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, "
        "data BLOB NOT NULL);"
        "CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
    )
    numbers = {name: number for number, name in enumerate(topics, 1)}
    base.executemany("INSERT INTO topics VALUES(?, ?, ?, 'cdr', '')", [(numbers[n], n, t) for n, t in topics.items()])
    rows = [(numbers[one.topic], one.log_ns, (pack or bytes)(wire(one))) for one in said]
    base.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", rows)
    base.commit()
    base.close()
    write_metadata(folder, said, "sqlite3", "drive_0.db3", packed=pack is not None)
    return folder


def write_metadata(folder: Path, said: Sequence[Said], storage: str, file: str, *, packed: bool = False) -> None:
    lines = [
        "rosbag2_bagfile_information:",
        "  version: 5",
        f"  storage_identifier: {storage}",
        f"  duration: {{nanoseconds: {said[-1].log_ns - said[0].log_ns}}}",
        f"  starting_time: {{nanoseconds_since_epoch: {said[0].log_ns}}}",
        f"  message_count: {len(said)}",
        f"  compression_format: '{'zstd' if packed else ''}'",
        f"  compression_mode: '{'MESSAGE' if packed else ''}'",
        f"  relative_file_paths: [{file}]",
        "  topics_with_message_count:",
    ]
    for name, ros_type in topics_of(said).items():
        number = sum(one.topic == name for one in said)
        about = f"{{name: {name}, type: {ros_type}, serialization_format: cdr, offered_qos_profiles: ''}}"
        lines.append(f"    - {{message_count: {number}, topic_metadata: {about}}}")
    (folder / "metadata.yaml").write_text("\n".join(lines) + "\n")


def write_ros1(file: Path, said: Sequence[Said]) -> Path:
    """Write a bag of ROS 1, format 2.0: one chunk for each ten messages, its indices, and the index at the end."""

    def record(fields: dict[str, bytes], data: bytes) -> bytes:
        head = b"".join(struct.pack("<I", len(n) + 1 + len(v)) + n.encode() + b"=" + v for n, v in fields.items())
        return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data

    def time(ns: int) -> bytes:
        return struct.pack("<II", *divmod(ns, 10**9))

    topics = list(topics_of(said).items())
    number = {name: struct.pack("<I", k) for k, (name, _) in enumerate(topics)}

    def connection(name: str, ros_type: str) -> bytes:
        text = {"type": ros_type.replace("/msg/", "/"), "md5sum": "*", "message_definition": "", "topic": name}
        data = b"".join(struct.pack("<I", len(n) + 1 + len(v)) + f"{n}={v}".encode() for n, v in text.items())
        return record({"op": b"\7", "conn": number[name], "topic": name.encode()}, data)

    connections = {name: connection(name, ros_type) for name, ros_type in topics}
    body, infos = bytearray(), []
    start = len(b"#ROSBAG V2.0\n") + 4096
    known: set[str] = set()
    for begin in range(0, len(said), 10):
        some, chunk = said[begin : begin + 10], bytearray()
        index: dict[str, bytes] = {}
        for one in some:
            if one.topic not in known:
                chunk += connections[one.topic]
                known.add(one.topic)
            index[one.topic] = index.get(one.topic, b"") + time(one.log_ns) + struct.pack("<I", len(chunk))
            fields = {"op": b"\2", "conn": number[one.topic], "time": time(one.log_ns)}
            chunk += record(fields, wire(one, ros1=True))
        at = start + len(body)
        body += record({"op": b"\5", "compression": b"none", "size": struct.pack("<I", len(chunk))}, bytes(chunk))
        counts = b""
        for name, rows in index.items():
            count = struct.pack("<I", len(rows) // 12)
            body += record({"op": b"\4", "ver": b"\1\0\0\0", "conn": number[name], "count": count}, rows)
            counts += number[name] + count
        fields = {
            "op": b"\6", "ver": b"\1\0\0\0", "chunk_pos": struct.pack("<Q", at), "start_time": time(some[0].log_ns),
            "end_time": time(some[-1].log_ns), "count": struct.pack("<I", len(index)),
        }  # fmt: skip
        infos.append(record(fields, counts))
    head = {
        "op": b"\3", "index_pos": struct.pack("<Q", start + len(body)), "conn_count": struct.pack("<I", len(topics)),
        "chunk_count": struct.pack("<I", len(infos)),
    }  # fmt: skip
    short = record(head, b"")
    first = short[:-4] + struct.pack("<I", 4096 - len(short)) + b" " * (4096 - len(short))
    file.write_bytes(b"#ROSBAG V2.0\n" + first + bytes(body) + b"".join(connections.values()) + b"".join(infos))
    return file


HEADER = (
    "================================================================================\nMSG: std_msgs/Header\n"
    "builtin_interfaces/Time stamp\nstring frame_id\n"
)
POSE = "float64 x\nfloat64 y\nfloat64 z\nfloat64 qx\nfloat64 qy\nfloat64 qz\nfloat64 qw\n"
DEFINITIONS = {
    "cloud": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nPointField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n"
        f"{HEADER}================================================================================\n"
        "MSG: sensor_msgs/PointField\nuint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\n"
        "uint8 UINT32=6\nuint8 FLOAT32=7\nuint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n"
    ),
    "odometry": f"std_msgs/Header header\nstring child\n{POSE}float64[78] rest\n{HEADER}",
    "tf": (
        f"L[] transforms\n{HEADER}================================================================================\n"
        f"MSG: tf2_msgs/L\nstd_msgs/Header header\nstring child\n{POSE}"
    ),
}
"""Definitions with the layouts of ROS's own."""


def as_values(one: Said) -> dict[str, Any]:
    content = one.content
    seconds, nanos = divmod(content["stamp_ns"], 10**9)
    header = {"stamp": {"sec": seconds, "nanosec": nanos}, "frame_id": content["frame"]}
    if one.kind == "cloud":
        rows = content["rows"]
        names = ("x", "y", "z", "time")
        return {
            "header": header, "height": 1, "width": len(rows), "is_bigendian": False, "point_step": 16,
            "fields": [{"name": n, "offset": 4 * k, "datatype": 7, "count": 1} for k, n in enumerate(names)],
            "row_step": 16 * len(rows), "data": rows.tobytes(), "is_dense": True,
        }  # fmt: skip
    x, y, z = content["position"]
    where = {"child": content["child"], "x": x, "y": y, "z": z, "qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0}
    if one.kind == "tf":
        return {"transforms": [{"header": header, **where}]}
    return {"header": header, **where, "rest": [0.0] * 78}


def write_mcap_ros2(file: Path, said: Sequence[Said], compression: CompressionType = CompressionType.ZSTD) -> Path:
    """Write a single MCAP file as mcap's own writer for ROS 2 does."""
    with file.open("wb") as stream:
        writer = Ros2Writer(stream, chunk_size=20_000, compression=compression)
        schemas = {kind: writer.register_msgdef(TYPES[kind], text) for kind, text in DEFINITIONS.items()}
        for one in said:
            writer.write_message(one.topic, schemas[one.kind], as_values(one), one.log_ns, one.log_ns)
        writer.finish()
    return file


def write_mcap_folder(folder: Path, said: Sequence[Said]) -> Path:
    folder.mkdir()
    write_mcap_ros2(folder / "drive_0.mcap", said)
    write_metadata(folder, said, "mcap", "drive_0.mcap")
    return folder


# Foxglove -------------------------------------------------------------------------------------------------------------


def foxglove(one: Said) -> Any:
    """Return a message as Foxglove's in protobuf."""
    content = one.content
    if one.kind == "cloud":
        rows, size = content["rows"], content["rows"].itemsize
        kind = {4: PackedElementField.FLOAT32, 8: PackedElementField.FLOAT64}[size]
        stride = size * rows.shape[1]
        message: Any = PointCloud(frame_id=content["frame"], point_stride=stride, data=rows.tobytes())
        for k in range(rows.shape[1]):
            message.fields.add(name=("x", "y", "z", "time")[k], offset=size * k, type=kind)
    elif one.kind == "odometry":
        message = Odometry(frame_id=content["frame"], body_frame_id=content["child"])
        (message.pose.position.x, message.pose.position.y, message.pose.position.z) = content["position"]
        message.pose.orientation.w = 1.0
    else:
        message = FrameTransform(parent_frame_id=content["frame"], child_frame_id=content["child"])
        (message.translation.x, message.translation.y, message.translation.z) = content["position"]
        message.rotation.w = 1.0
    message.timestamp.FromNanoseconds(content["stamp_ns"])
    return FrameTransforms(transforms=[message]) if one.kind == "tf" else message


def write_foxglove(
    file: Path, said: Sequence[Said], encoding: str = "protobuf", encode: Callable[[Any], bytes] | None = None
) -> Path:
    """Write an MCAP file of Foxglove's messages with mcap's own writer."""
    encode = encode or (lambda message: message.SerializeToString())
    with file.open("wb") as stream:
        writer = Writer(stream, chunk_size=20_000)
        writer.start(profile="", library="a test")
        channels: dict[str, int] = {}
        for one in said:
            message = foxglove(one)
            if one.topic not in channels:
                schema = writer.register_schema(message.DESCRIPTOR.full_name, encoding, b"")
                channels[one.topic] = writer.register_channel(one.topic, encoding, schema)
            writer.add_message(channels[one.topic], one.log_ns, encode(message), one.log_ns)
        writer.finish()
    return file
