"""Receives what robots publish while `roughmap doctor` listens."""

import queue
import threading
import time
from typing import Any, NamedTuple

import zenoh
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry as OdometryMessage

from roughmap_schemas import Cloud, Keys, MessageFault, Odometry, TimeField, check_encoding
from roughmap_schemas.kinds import Kind
from roughmap_schemas.wire import parse
from roughmap_service.cli.doctor.heard import (
    MAX_SAMPLES,
    HeardCloud,
    HeardPose,
    HeardSensor,
    HeardTransform,
    Robot,
)
from roughmap_service.cli.doctor.survey import survey
from roughmap_service.cli.doctor.times import TimeSample
from roughmap_service.host.log_growth import HOUR_S
from roughmap_service.inputs.subscriptions import ENCODINGS
from roughmap_service.run.decoding import decode
from roughmap_service.run.point_times import NAMES
from roughmap_service.run.settings import Settings

MAX_FRAMES = 64
"""Frames, and kinds of faults, that are told apart for one robot."""

MAX_NAME = 257
"""Characters kept of a frame's name: a configured one has at most 256."""

MAX_BYTES = 256 << 20
"""Bytes of messages that may wait to be read, and of points' times that are kept."""

RECORD_BYTES = 47
"""What the log adds to a message, as MCAP has it: the record's head (9), its numbers (22), its index entry (16)."""

MAX_SURVEYED = 64
"""Sensors whose clouds are looked at more closely."""

SURVEY_NS = 250_000_000
"""Time between two clouds of a sensor that are looked at more closely."""


class Message(NamedTuple):
    """A message as it arrived: ``number`` and ``source`` (its publisher) as far as it has them."""

    kind: Kind
    robot: str
    payload: bytes
    encoding: str
    arrival_ns: int
    number: int | None = None
    source: str = ""


class Traffic:
    """Collects what robots publish, in `robots` by name.

    Arrivals are in ns on this machine's clock as it stood at the beginning, so that they never leap.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._surveyed = 0
        self._sample_bytes = 0
        self._waiting: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._bytes = 0
        self._base_ns = time.time_ns() - time.monotonic_ns()
        self.robots: dict[str, Robot] = {}
        self.ended_ns = 0
        self.heard_bytes = 0
        """Bytes of the messages that a service would log."""
        self.missed = 0
        """Messages that arrived faster than they could be read."""

    def bytes_per_hour(self, seconds: float) -> int:
        """Return by how many bytes an hour a log would grow if it goes on as in these ``seconds``."""
        return round(self.heard_bytes * HOUR_S / seconds)

    def listen(self, session: zenoh.Session, keys: Keys, seconds: float) -> None:
        """Collect what is published within ``seconds``."""
        subscribers = []
        for kind, key, parse_key in (
            (Kind.POINTS, keys.points_any, keys.parse_points),
            (Kind.ODOMETRY, keys.odometry_any, keys.parse_odometry),
            (Kind.TRANSFORM, keys.transform_any, keys.parse_transform),
        ):

            def arrive(sample: zenoh.Sample, kind: Kind = kind, parse_key: Any = parse_key) -> None:
                self._arrive(sample, kind, parse_key)

            subscribers.append(session.declare_subscriber(key, arrive))
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._take_next(left)
        for subscriber in subscribers:
            subscriber.undeclare()
        self.ended_ns = self._base_ns + time.monotonic_ns()
        while self._take_next(0.0):
            pass

    def _arrive(self, sample: zenoh.Sample, kind: Kind, parse_key: Any) -> None:
        """Note a message, in one of Zenoh's threads: it is read elsewhere, so that the next one's arrival is right."""
        arrival_ns = self._base_ns + time.monotonic_ns()
        try:
            robot = parse_key(str(sample.key_expr))
        except MessageFault:
            return  # not a robot's key
        if not self._has_room(len(sample.payload)):
            return
        attachment = sample.attachment
        number = None
        if attachment is not None and len(attachment) == 8:
            number = int.from_bytes(attachment.to_bytes(), "little")
        source = "" if sample.source_info is None else str(sample.source_info.source_id)
        self._waiting.put(
            Message(kind, robot, sample.payload.to_bytes(), str(sample.encoding), arrival_ns, number, source)
        )

    def put(self, message: Message) -> None:
        """Take a message that came another way than `listen`, now; any thread may call it."""
        if self._has_room(len(message.payload)):
            self._waiting.put(message._replace(arrival_ns=self._base_ns + time.monotonic_ns()))

    def _has_room(self, size: int) -> bool:
        """Tell whether a message of that size may wait, and count it if so."""
        with self._lock:
            if self._bytes + size > MAX_BYTES:
                self.missed += 1
                self.heard_bytes += size
                return False
            self._bytes += size
        return True

    def _take_next(self, wait_s: float) -> bool:
        try:
            message = self._waiting.get(timeout=wait_s) if wait_s > 0 else self._waiting.get_nowait()
        except queue.Empty:
            return False
        with self._lock:
            self._bytes -= len(message.payload)
        self.take(message)
        return True

    def take(self, message: Message) -> None:
        """Read one message and keep what the judgements need of it."""
        if message.robot not in self.robots and len(self.robots) >= self._settings.max_robots:
            return
        robot = self.robots.setdefault(message.robot, Robot())
        tally = robot.tallies[message.kind]
        tally.number += 1
        if message.number is None:
            tally.unnumbered += 1
        else:
            tally.numbers.add(message.number, message.source)
        try:
            check_encoding(message.encoding, ENCODINGS[message.kind])
            content = decode(message.kind, message.payload, self._settings)
            self.heard_bytes += len(message.payload) + RECORD_BYTES
            if isinstance(content, Cloud):
                self._take_cloud(message, content, robot)
            elif isinstance(content, Odometry):
                covariance = tuple(parse(message.payload, OdometryMessage).pose_covariance[:37])
                robot.poses.append(
                    HeardPose(
                        message.arrival_ns, content.stamp_ns, content.frame_id[:MAX_NAME], content.position,
                        content.rotation, covariance,
                    )
                )  # fmt: skip
            else:
                robot.transforms.append(
                    HeardTransform(
                        message.arrival_ns, content.stamp_ns, content.parent_frame_id[:MAX_NAME],
                        content.child_frame_id,
                        content.translation, content.rotation,
                    )
                )  # fmt: skip
        except MessageFault as fault:
            tally.faults[f"{fault.code}: {fault.message}" if len(tally.faults) < MAX_FRAMES else "others"] += 1

    def _take_cloud(self, message: Message, cloud: Cloud, robot: Robot) -> None:
        frame = cloud.frame_id[:MAX_NAME]
        if frame not in robot.sensors and len(robot.sensors) >= MAX_FRAMES:
            return
        sensor = robot.sensors.setdefault(frame, HeardSensor())
        begun = not sensor.clouds
        sensor.clouds.append(HeardCloud(message.arrival_ns, cloud.stamp_ns, len(cloud.points)))
        if begun:
            self._surveyed += 1
            sensor.looked_at = self._surveyed <= MAX_SURVEYED
        if not sensor.looked_at:
            return
        if len(sensor.samples) < MAX_SAMPLES and len(cloud.points) > 1:
            sample = self._sample(message.robot, cloud)
            self._sample_bytes += sum(one.values.nbytes for one in sample.fields)
            if self._sample_bytes <= MAX_BYTES:
                sensor.samples.append(sample)
        if begun or message.arrival_ns - sensor.surveyed_ns >= SURVEY_NS:
            sensor.surveyed_ns = message.arrival_ns
            sensor.surveys.append(survey(cloud.points, self._settings.config.map.cell_size))

    def _sample(self, robot: str, cloud: Cloud) -> TimeSample:
        """Copy the fields of a cloud that may hold its points' times: they are views of the payload."""
        configured = self._settings.config.sensor(robot, cloud.frame_id)
        names = {*NAMES, configured.time_field} if configured is not None else set(NAMES)
        fields = tuple(TimeField(one.name, one.values.copy()) for one in cloud.time_fields if one.name in names)
        others = tuple(one.name for one in cloud.time_fields if one.name not in names)
        return TimeSample(cloud.stamp_ns, fields, others)
