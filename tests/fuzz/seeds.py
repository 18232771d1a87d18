"""Rewrites the inputs that fuzzing begins with in corpus/TARGET/seed-...: good ones, and ones just beside good."""

import io
import json
import sqlite3
import struct
import sys
import tempfile
from contextlib import closing
from pathlib import Path

import laspy
import numpy as np
import xxhash
import zstandard
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from mcap.writer import CompressionType, Writer
from ros_targets import TOPICS
from targets import CORPUS, TARGETS

from roughmap.cell import STATE_VERSION
from roughmap_ros.messages import cells_cdr, grid_map_cdr, tf_cdr
from roughmap_ros.wire.attachment import Attachment, pack_attachment
from roughmap_schemas import (
    CheckpointEvent,
    Config,
    ForgetEvent,
    IntegrationEvent,
    QueryError,
    Receipt,
    ResetEvent,
    RunMetadata,
    TileInfo,
    encode_cloud,
    encode_event,
    encode_odometry,
    encode_transform,
    model_bytes,
)
from roughmap_schemas.grid import encode_grid
from roughmap_schemas.transform import Transform
from roughmap_service.store.map_db import SCHEMA, STATE_BYTES, _checksum, tile_checksum

T0 = 1_700_000_000 * 10**9
LEVEL = (0.0, 0.0, 0.0, 1.0)
RUN = "0123456789abcdef" * 2


def clouds() -> list[bytes]:
    points = np.arange(9.0).reshape(3, 3)
    message = PointCloud.FromString(encode_cloud(points, T0, "lidar"))
    message.pose.orientation.w = 2.0
    message.pose.position.x = 1.5
    message.fields.append(PackedElementField(name="t", offset=24, type=8))
    message.point_stride, message.data = 32, np.arange(12.0).tobytes()
    return [
        encode_cloud(points.astype(np.float32), T0, "lidar", offsets_ns=[0, 5, 10**9]),
        encode_cloud(np.full((2, 3), np.nan), 0, "map"),
        message.SerializeToString(),
        encode_cloud(np.zeros((0, 3)), T0, ""),
    ]


def grids() -> tuple[list[bytes], list[bytes]]:
    layer = {"mean_height": np.zeros((64, 64), np.float32)}
    layer["mean_height"][:2] = np.nan
    info = TileInfo(
        map="site", instance=RUN, epoch=1, z=0, x=0, y=0, sequence=1, map_sequence=1, answer_tiles=1, oldest_ns=0,
        newest_ns=T0, known_cells=4096, digest=RUN, configuration_digest=RUN, compression="zstd",
    )  # fmt: skip
    packed = encode_grid(layer, (0.0, 0.0), 0.1, T0, "map", "f4", "zstd")
    small = encode_grid({"range": np.ones((2, 3))}, (-6.4, 0.0), 0.2, T0, "map", "f8")
    lone = info.model_copy(update={"compression": None, "x": None, "y": None, "digest": None})
    cell = {"map": "site", "instance": RUN, "epoch": 1, "sequence": 2, "configuration_digest": RUN}
    cell["cells"] = [{"i": 0, "j": -1, "state": None, "layers": {"mean_height": None}}]  # type: ignore[assignment]
    return [packed, small], [
        model_bytes(info) + b"\n" + packed,
        model_bytes(lone) + b"\n" + encode_grid({"mean_height": np.ones((2, 2))}, (0, 0), 0.1, T0, "map"),
        b"\n" + json.dumps(cell).encode(),
        b"application/json\n" + model_bytes(QueryError(code="busy", message="ask again")),
    ]


def event_list() -> list[bytes]:
    integration = IntegrationEvent(
        epoch=1, input=3, robot="rover", poses=[(1, 0), (2, 0)], outcome="integrated", accepted=2,
        rejected={"range": 1}, sequence=1,
    )  # fmt: skip
    return [
        encode_event(integration),
        encode_event(CheckpointEvent(epoch=1, sequence=1, digest=RUN)),
        encode_event(ResetEvent(epoch=2, sequence=2)),
        encode_event(ForgetEvent(epoch=1, sequence=2, tiles=[(-1, 0), (0, 0)])),
        b'{"kind": "edit", "epoch": 1}',
        model_bytes(Receipt(input=1, epoch=1)),
    ]


def a_log(compression: CompressionType, *, checksums: bool, closed: bool = True) -> bytes:
    """Without checksums a mutation reaches what lies behind them."""
    run = RunMetadata(
        run=RUN, created_ns=T0, epoch=1, index=0, first_input=1, first_record=1, base_sequence=0, base_digest="",
        version="0", configuration={},
    )  # fmt: skip
    entries = run.to_record()
    if not checksums:
        del entries["checksum"]
    stream = io.BytesIO()
    writer = Writer(stream, compression=compression, enable_crcs=checksums, enable_data_crcs=checksums)
    writer.start(profile="roughmap")
    writer.add_metadata("roughmap", entries)
    schema = writer.register_schema("foxglove.PointCloud", "protobuf", b"")
    topics = ("robots/rover/points", "robots/rover/odometry", "maps/site/events")
    channels = [writer.register_channel(topic, "protobuf", schema) for topic in topics]
    payloads = (clouds()[0], encode_odometry(T0, "map", (0, 0, 0), LEVEL), event_list()[0])
    for number, (channel, payload) in enumerate(zip(channels, payloads, strict=True)):
        writer.add_message(channel, T0 + number, payload, T0)
    if closed:
        writer.finish()
    else:
        writer.flush()
    return stream.getvalue()


def stores() -> list[bytes]:
    raw = bytes(STATE_BYTES[0])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.db"
        with closing(sqlite3.connect(path)) as db, db:
            db.execute("PRAGMA page_size = 512")
            db.executescript(SCHEMA)
            texts = {"run": json.dumps(RUN), "state_version": str(STATE_VERSION), "epoch": "1"}
            db.executemany("INSERT INTO cut VALUES (?, ?)", [*texts.items(), ("checksum", _checksum(texts))])
            checksum = tile_checksum(np.array([0, 0, 0, T0]))
            tile = (0, 0, 0, T0, checksum, xxhash.xxh3_128_digest(raw), zstandard.compress(raw))
            db.execute("INSERT INTO tiles VALUES (?, ?, ?, ?, ?, ?, ?)", tile)
        return [path.read_bytes()]


def ros_messages() -> dict[str, list[bytes]]:
    """Messages by topic, little-endian, and one of the other order."""
    covariance = np.eye(6) * 1e-4
    poses = [
        Transform(T0 + n * 10**8, parent, child, (0.1 * n, 0.0, 0.0), LEVEL)
        for n in range(3)
        for parent, child in (("map", "odom"), ("odom", "base"))
    ]
    mounting = Transform(0, "base", "lidar", (0.0, 0.0, 1.0), LEVEL)
    heights = np.arange(6, dtype=np.float32).reshape(2, 3)
    cloud = cells_cdr(heights, {"t": heights}, (0.0, 0.0), 1.0, (0.0, 0.0, 0.0), T0, "lidar")
    header = struct.pack("<4sIII4s", b"\0\1\0\0", T0 // 10**9, 0, 4, b"map\0")
    numbers = struct.pack("<7d", 1, 2, 3, *LEVEL)
    body = struct.pack("<I5s7x", 5, b"base\0")  # aligned to 8 after the CDR header
    odometry = header + body + numbers + covariance.tobytes() + bytes(8 * 42)
    return {
        "/points": [cloud],
        "/odom": [odometry],
        "/tf": [tf_cdr(poses[n : n + 2]) for n in range(0, 6, 2)],
        "/tf_static": [tf_cdr([mounting])],
        "other": [header + numbers, grid_map_cdr({"a": heights}, (0.0, 0.0), 0.1, T0, "map", ["a"])],
    }


def ros_feed() -> bytes:
    """A robot's messages, as the target `ros_feed` takes them."""
    order = ("/tf_static", "/points", "/tf", "/odom", "/points")
    made = ros_messages()
    parts = [(TOPICS.index(topic), message) for topic in order for message in made[topic]]
    return b"".join(bytes([topic, 10]) + struct.pack("<H", len(message)) + message for topic, message in parts)


def las(points: np.ndarray) -> bytes:
    file = laspy.LasData(laspy.LasHeader(version="1.2", point_format=1))
    file.x, file.y, file.z = points.T
    stream = io.BytesIO()
    file.write(stream)
    return stream.getvalue()


def npz(**arrays: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def corpus() -> dict[str, list[bytes]]:
    points = np.arange(12.0, dtype=np.float32).reshape(4, 3)
    grid, reply = grids()
    none, zstd, lz4 = CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4
    public = Config().public_dict()
    return {
        "cloud": clouds(),
        "odometry": [
            encode_odometry(T0, "map", (1, 2, 3), LEVEL, np.eye(6)),
            encode_odometry(0, "", (0, 0, 0), (0, 0, 5, 0)),
        ],
        "transform": [encode_transform(T0, "map", "odom", (1, 2, 3), LEVEL)],
        "grid": grid,
        "selectors": [
            b"layers=mean_height,range;bbox=-1,-2,3,4e1;since=7;epoch=2;dtype=f8;compression=zstd",
            b"bbox=0,0,1,1;level=3;tolerance=0.1;limits=slope:0.5,step:0.2,confidence:0.9",
            b"_timeout=5;layers=slope",
        ],
        "cells": [b"x=1.5;y=-2", b"layers=slope\n[[1, 2], [-3.5e1, 0]]", b"limits=slope:1\n[]"],
        "keys": [
            b"robots/rover1/points", b"maps/site/ingest/r.1-_/odometry", b"maps/site/tiles/0/*/-5",
            b"maps/site/updates/1/2/3", b"maps/site/alive/" + RUN.encode(), b"a/{robot}/b",
        ],
        "events": event_list(),
        "replies": reply,
        "configuration": [
            b'[map]\ncell_size = 0.2\nbounds = [0, 0, 1, 1]\n[sensors.lidar]\nrange_sigma = 0.1\n\0INPUT__ROBOTS=["a"]',
            b"[robots.r.sensors.lidar]\nrange_sigma = 1\n[keys]\npoints = \"a/{robot}\"\n\0MAP__MEMORY_LIMIT=1GiB",
            b"[map.limits]\nslope = 1\n\0HTTP__LISTEN=\nZENOH__PASSWORD=x",
            "".join(
                f"[{name}]\n" + "".join(f"{k} = {json.dumps(v)}\n" for k, v in table.items() if v is not None)
                for name, table in public.items()
                if name not in ("keys", "robots", "sensors", "map")
            ).encode(),
        ],
        "log": [
            a_log(none, checksums=True), a_log(none, checksums=False), a_log(zstd, checksums=False),
            a_log(lz4, checksums=False), a_log(none, checksums=True, closed=False),
        ],
        "blob": [
            *(bytes(16) + zstandard.compress(bytes(size)) for size in STATE_BYTES),
            bytes(16) + zstandard.compress(b"a" * 100),
        ],
        "store": stores(),
        "stored": [
            b'trun\nt"a"\ni1\ni0\ni0\ni0\ni5\nb0123456789abcdef\nbxyz', b"i7\nf1.5\nbz\nf2.5\nn\ni9223372036854775807",
        ],
        "clouds_npz": [
            npz(points=points), npz(points=points, covariance=np.eye(3), stamp_ns=np.array(T0)),
            npz(points=points.astype(np.int32), scan_start=np.array([0, 2, 4]), pose=np.tile(np.eye(4), (2, 1, 1))),
        ],
        "clouds_text": [
            b"x,y,z\n1,2,3\n4;5;6\n# no\n7 8 9 10\n",
            b"1\t2\t3\nnan inf 1e400\n",
            b"x;y;z;i\n1,5;-2,25;,5;7\n3;4;5;6\n",
            b"//X Y Z R\n2\n1 2 3 4\n5 6 7 8\n1\n1 2 nan 4\n",
            b'"E","N","H [m]"\n"1.5","2","3"\n1,,-9999\n',
        ],
    }  # fmt: skip


def more_corpus() -> dict[str, list[bytes]]:
    points = np.arange(12.0, dtype="<f4").reshape(4, 3)
    xyz = "property float x\nproperty float y\nproperty float z\n"
    ply = f"element vertex 4\n{xyz}end_header\n"
    face = "element face 2\nproperty list uchar int i\n"
    pcd = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 4\nHEIGHT 1\nVIEWPOINT {}\nPOINTS 4\n"
    text = "1 2 3\n4 5 6\n7 8 9\n1 1 1\n"
    literal = bytes([31]) + points.T.tobytes()[:32] + bytes([15]) + points.T.tobytes()[32:]
    token = "@ros2_lv/0/1a2b/0/7/MP/%/%robot/driver/%points/sensor_msgs::msg::dds_::PointCloud2_/RIHS01_0a/::,5:,:,:,,"
    return {
        "clouds_ply": [
            f"ply\nformat ascii 1.0\ncomment c\n{ply}{text}".encode(),
            f"ply\nformat binary_little_endian 1.0\n{ply}".encode() + points.tobytes(),
            f"ply\nformat binary_big_endian 1.0\n{face}{ply}".encode()
            + (b"\1" + bytes(4)) * 2
            + points.astype(">f4").tobytes(),
        ],
        "clouds_pcd": [
            (pcd.format("0 0 0 1 0 0 0") + "DATA ascii\n" + text).encode(),
            (pcd.format("1 2 3 1 0 0 0") + "DATA binary\n").encode() + points.tobytes(),
            (pcd.format("0 0 0 1 0 0 0") + "DATA binary_compressed\n").encode()
            + struct.pack("<II", len(literal), 48)
            + literal,
        ],
        "clouds_las": [las(points)],
        "ros_names": [
            token.encode(),
            b"@ros2_lv/0/1a2b/0/0/NN/%/%/driver\n0/robot/points/sensor_msgs::msg::dds_::PointCloud2_/RIHS01_0a",
            pack_attachment(Attachment(1, T0, bytes(range(16)))),
        ],
        "ros_messages": [message for some in ros_messages().values() for message in some],
        "ros_feed": [ros_feed()],
    }


def main() -> None:
    made = corpus() | more_corpus()
    assert sorted(made) == sorted(TARGETS)
    for target, inputs in made.items():
        folder = CORPUS / target
        folder.mkdir(parents=True, exist_ok=True)
        for old in folder.glob("seed-*"):
            old.unlink()
        for number, payload in enumerate(inputs):
            (folder / f"seed-{number}").write_bytes(payload)
            TARGETS[target](payload)


if __name__ == "__main__":
    sys.exit(main())
