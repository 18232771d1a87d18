"""A client of roughmap without roughmap: Zenoh, protobuf, JSON and numpy, written from schemas/README.md alone.

It sends poses and scans, asks for tiles, a region and cells, follows updates, reads the status, and reads the log:

    roughmap serve -c schemas/examples/raw_client.toml
    python schemas/examples/raw_client.py drive tcp/127.0.0.1:7447
    python schemas/examples/raw_client.py log log

`drive` and `log` each print one line of JSON.
"""

import argparse
import json
import queue
import struct
import time
from collections import Counter
from pathlib import Path

import numpy as np
import zenoh
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from mcap.exceptions import EndOfFile
from mcap.records import Channel, Message, Metadata
from mcap.stream_reader import StreamReader

MAP, ROBOT = "site", "rover1"
MAJOR = "1"
"""The major version of the contract that this client speaks."""

TIMEOUT_S = 20.0
RECEIPT_S = 2.0
RETRY = {"busy", "shutting_down", "log_unavailable"}

POINTS = "application/protobuf;foxglove.PointCloud"
ODOMETRY = "application/protobuf;foxglove.Odometry"
NUMPY = {7: "<f4", 8: "<f8"}


class Refused(Exception):
    """The service answered with an error."""

    def __init__(self, code, message):
        super().__init__(f"{code}: {message}")
        self.code = code


def check_contract(reply):
    """Refuse a service of another major version, by name."""
    version = reply.get("contract")
    if version is None or version.split(".")[0] != MAJOR:
        raise SystemExit(f"the service speaks contract {version or 'older than 1.0'}, this client speaks {MAJOR}.x")
    return reply


def connect(endpoint):
    """Open a session as a client of one endpoint."""
    config = zenoh.Config()
    for path, value in (
        ("mode", "client"),
        ("connect/endpoints", [endpoint]),
        ("scouting/multicast/enabled", False),
    ):
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


# Queries ------------------------------------------------------------------------------------------------------------


def get(session, selector, payload=None, encoding=None, timeout=TIMEOUT_S):
    """Ask once: all replies, or Refused, or TimeoutError."""
    samples = []
    for reply in session.get(
        selector,
        payload=payload,
        encoding=encoding,
        timeout=timeout,
        consolidation=zenoh.ConsolidationMode.NONE,
        target=zenoh.QueryTarget.ALL_COMPLETE,
    ):
        if reply.ok is not None:
            samples.append(reply.ok)
            continue
        error = reply.err.payload.to_bytes()
        if error == b"Timeout":
            raise TimeoutError(selector)
        error = check_contract(json.loads(error))
        raise Refused(error["code"], error["message"])
    return samples


def get_json(session, selector, payload=None):
    """Ask a query that has one JSON reply."""
    samples = get(session, selector, payload)
    if len(samples) != 1:
        raise SystemExit(f"{selector}: {len(samples)} replies; expected one service")
    return check_contract(json.loads(samples[0].payload.to_bytes()))


def ingest(session, kind, payload, encoding):
    """Send a message until its receipt comes: the same bytes are the same message."""
    pause = 0.1
    until = time.monotonic() + TIMEOUT_S
    while True:
        try:
            samples = get(session, f"maps/{MAP}/ingest/{ROBOT}/{kind}", payload, encoding, RECEIPT_S)
            if samples:
                return check_contract(json.loads(samples[0].payload.to_bytes()))
        except TimeoutError:
            pass
        except Refused as refused:
            if refused.code not in RETRY:
                raise
        if time.monotonic() > until:
            raise TimeoutError(f"no receipt for {kind}")
        time.sleep(pause)
        pause = min(2 * pause, 2.0)


def read_grid(sample):
    """Take a tile, region or update apart: its TileInfo, its layers (rows, columns) and its lower-left corner."""
    info = check_contract(json.loads(sample.attachment.to_bytes()))
    grid = Grid.FromString(sample.payload.to_bytes())
    shape = len(grid.data) // grid.row_stride, grid.column_count
    layers = {
        field.name: np.ndarray(
            shape, NUMPY[field.type], grid.data, field.offset, strides=(grid.row_stride, grid.cell_stride)
        )
        for field in grid.fields
    }
    return info, layers, (grid.pose.position.x, grid.pose.position.y)


def get_tiles(session, parameters=""):
    """Ask for tiles of level 0: all of one answer, which is one state of one map."""
    tiles = [read_grid(sample) for sample in get(session, f"maps/{MAP}/tiles/0/*/*{parameters}")]
    states = {(info["instance"], info["epoch"], info["map_sequence"]) for info, _, _ in tiles}
    if len(states) > 1 or any(info["answer_tiles"] != len(tiles) for info, _, _ in tiles):
        raise SystemExit(f"{len(tiles)} tiles of {len(states)} states are not one whole answer")
    return tiles


# Messages -----------------------------------------------------------------------------------------------------------


def odometry(stamp_ns, position, sigma=0.001):
    """Encode a pose without rotation, its errors independent."""
    message = Odometry(frame_id="map", body_frame_id="base_link")
    message.timestamp.FromNanoseconds(stamp_ns)
    message.pose.position.x, message.pose.position.y, message.pose.position.z = position
    message.pose.orientation.w = 1.0
    message.pose_covariance.extend((np.eye(6) * sigma**2).ravel().tolist())
    return message.SerializeToString()


def cloud(stamp_ns, frame_id, points, offsets_ns):
    """Encode points (N, 3) with a time for each, nanoseconds after the stamp."""
    packed = np.empty(len(points), np.dtype([("xyz", "<f4", 3), ("t", "<u4")]))
    packed["xyz"], packed["t"] = points, offsets_ns
    message = PointCloud(frame_id=frame_id, point_stride=packed.itemsize, data=packed.tobytes())
    message.timestamp.FromNanoseconds(stamp_ns)
    for offset, name in enumerate("xyz"):
        message.fields.add(name=name, offset=4 * offset, type=PackedElementField.FLOAT32)
    message.fields.add(name="t", offset=12, type=PackedElementField.UINT32)
    return message.SerializeToString()


def publisher(session, kind, encoding):
    """Return a function that publishes messages of a kind, each with its number."""
    declared = session.declare_publisher(
        f"robots/{ROBOT}/{kind}", encoding=encoding, congestion_control=zenoh.CongestionControl.BLOCK
    )
    number = 0

    def put(payload):
        nonlocal number
        number += 1
        declared.put(payload, attachment=struct.pack("<Q", number))

    return put


# Following the map --------------------------------------------------------------------------------------------------


class HeldMap:
    """Level 0 of the map, kept up to date as the README says."""

    def __init__(self, session):
        self.session = session
        self.updates = queue.Queue()
        self.subscriber = session.declare_subscriber(f"maps/{MAP}/updates/0/*/*", self.updates.put)
        self.tiles = {}
        self.version = None  # instance, epoch, and the map_sequence of the last answer
        self.applied = 0
        self.catch_up()

    def catch_up(self):
        """Ask for what changed since the last whole answer."""
        held = self.version
        since = f"?since={held[2]};epoch={held[1]}" if held else ""
        try:
            tiles = get_tiles(self.session, since)
        except Refused as refused:
            if refused.code != "since_ahead":
                raise
            held, tiles = None, get_tiles(self.session)
        if not tiles:
            status = get_json(self.session, f"maps/{MAP}/status")
            if held is None or (status["instance"], status["epoch"]) != held[:2]:
                self.tiles, self.version = {}, (status["instance"], status["epoch"], 0)
            return
        info = tiles[0][0]
        version = info["instance"], info["epoch"], info["map_sequence"]
        if held is None or version[:2] != held[:2]:
            self.tiles = {}
        self.tiles |= {(info["x"], info["y"]): (info, layers) for info, layers, _ in tiles}
        self.version = version

    def apply(self, sample):
        """Take an update, if it is newer than what is held; catch up first if it is of another instance or epoch."""
        info, layers, _ = read_grid(sample)
        state = info["instance"], info["epoch"]
        if state != self.version[:2]:
            self.catch_up()
        key = info["x"], info["y"]
        if state != self.version[:2]:
            return  # older than what the service answered just now
        if key not in self.tiles or info["sequence"] > self.tiles[key][0]["sequence"]:
            self.tiles[key] = info, layers
            self.applied += 1

    def follow_to(self, sequence):
        """Apply updates until the map's state is at least this one."""
        while True:
            sample = self.updates.get(timeout=TIMEOUT_S)
            self.apply(sample)
            if json.loads(sample.attachment.to_bytes())["map_sequence"] >= sequence:
                return


# The two commands ---------------------------------------------------------------------------------------------------


def drive(endpoint):
    """Feed a map and ask it everything."""
    t0 = 1_700_000_000 * 10**9
    found = {}
    with connect(endpoint) as session:
        status = get_json(session, f"maps/{MAP}/status")  # the service's subscriptions are known from here on
        events = queue.Queue()
        _subscriber = session.declare_subscriber(
            f"maps/{MAP}/events", lambda sample: events.put(json.loads(sample.payload.to_bytes()))
        )
        get_json(session, f"maps/{MAP}/status")  # and ours is known to the service
        held = HeldMap(session)

        # Poses around the scan, published; the scan itself, ingested. The robot drives 1 m/s, its sensor 1 m above flat
        # ground: each point is placed at its own time.
        put_pose = publisher(session, "odometry", ODOMETRY)
        for k in range(4):
            put_pose(odometry(t0 + k * 50_000_000, (0.05 * k, 0.0, 1.0)))
        x, y = np.meshgrid(np.arange(0.55, 2.5, 0.1), np.arange(-0.95, 1.0, 0.1))
        points = np.stack([x.ravel(), y.ravel(), np.full(x.size, -1.0)], axis=1)
        offsets = np.linspace(0, 100_000_000, len(points)).astype(np.int64)
        scan = cloud(t0 + 20_000_000, "lidar", points, offsets)
        receipts = [ingest(session, "points", scan, POINTS) for _ in range(2)]
        found["same_input"] = receipts[0]["input"] == receipts[1]["input"]
        found["duplicates"] = [receipt["duplicate"] for receipt in receipts]

        # Two points that are already in the map's frame, published. One alone is not yet taken for ground.
        publisher(session, "points", POINTS)(cloud(t0, "map", np.array([[10.05, 0.05, 1.25]] * 2), [0, 0]))
        decided = {}
        while len(decided) < 2:
            event = events.get(timeout=TIMEOUT_S)
            if event["kind"] == "integration":
                decided[event["input"]] = event
        scanned = decided[receipts[0]["input"]]
        found["outcomes"] = sorted(event["outcome"] for event in decided.values())
        found["accepted"] = scanned["accepted"]
        found["poses"] = len(scanned["poses"])
        sequence = max(event["sequence"] for event in decided.values())

        # Queries. The events came, so the answers show their points.
        tiles = get_tiles(session, "?layers=mean_height,count")
        found["tiles"] = sorted((info["x"], info["y"]) for info, _, _ in tiles)
        found["known_in_tiles"] = int(sum((layers["count"] > 0).sum() for _, layers, _ in tiles))
        found["known_cells"] = sum(info["known_cells"] for info, _, _ in tiles)
        (sample,) = get(session, f"maps/{MAP}/region?bbox=0.6,-0.9,2.4,0.9;layers=mean_height,std_dev;dtype=f8")
        _, layers, origin = read_grid(sample)
        found["region"] = {
            "shape": layers["mean_height"].shape,
            "origin": [round(value, 9) for value in origin],
            "largest_height": float(np.nanmax(np.abs(layers["mean_height"]))),
        }
        answer = get_json(
            session,
            f"maps/{MAP}/cells?layers=mean_height,std_dev",
            json.dumps([[10.05, 0.05], [-50.0, 50.0]]).encode(),
        )
        found["cells"] = answer["cells"]
        try:
            get(session, f"maps/{MAP}/region?bbox=1,0,0,1")
        except Refused as refused:
            found["refused"] = refused.code

        # Updates, and the query that makes up for any that were missed.
        held.follow_to(sequence)
        held.catch_up()
        found["updates_applied"] = held.applied > 0
        found["held_is_map"] = {key: info["digest"] for key, (info, _) in held.tiles.items()} == {
            (info["x"], info["y"]): info["digest"] for info, _, _ in tiles
        }
        status = get_json(session, f"maps/{MAP}/status")
        found["status"] = {
            name: status[name] for name in ("contract", "map", "sequence", "input", "health", "refused", "gaps")
        }
        found["alive"] = [
            str(reply.ok.key_expr) == f"maps/{MAP}/alive/{status['instance']}"
            for reply in session.liveliness().get(f"maps/{MAP}/alive/*", timeout=TIMEOUT_S)
        ]
    return found


def read_log(folder):
    """Read all files of a folder in the order of their numbers, the last one up to where it breaks off."""
    runs, topics, events = set(), Counter(), Counter()
    inputs = 0
    for path in sorted(Path(folder).glob("roughmap-*.mcap")):
        channels = {}
        with path.open("rb") as stream:
            try:
                for record in StreamReader(stream).records:
                    if isinstance(record, Metadata) and record.name == "roughmap":
                        runs.add(record.metadata["run"])
                        inputs = int(record.metadata["first_input"]) - 1
                    elif isinstance(record, Channel):
                        channels[record.id] = record.topic
                    elif isinstance(record, Message):
                        topic = channels[record.channel_id]
                        topics[topic] += 1
                        if topic.startswith("robots/"):
                            inputs += 1
                            if record.sequence != inputs % 2**32:
                                raise SystemExit(f"{path}: input {inputs} has the number {record.sequence}")
                        elif topic.endswith("/events"):
                            events[json.loads(record.data)["kind"]] += 1
            except EndOfFile:
                continue  # the service was killed, or still writes
    return {"runs": len(runs), "inputs": inputs, "topics": dict(topics), "events": dict(events)}


def main():
    """Run one of the two commands."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for run, argument in ((drive, "endpoint"), (read_log, "folder")):
        command = commands.add_parser(run.__name__.removeprefix("read_"), help=run.__doc__.splitlines()[0])
        command.add_argument(argument)
        command.set_defaults(run=run, argument=argument)
    given = parser.parse_args()
    print(json.dumps(given.run(getattr(given, given.argument))))


if __name__ == "__main__":
    main()
