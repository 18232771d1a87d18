"""The checks before a message is logged: it must be valid, from a known robot and sensor, and have room to wait."""

import logging
from collections.abc import Collection
from contextlib import suppress
from itertools import islice
from typing import Final

from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

from roughmap_schemas import Cloud, MessageFault, Odometry, Refusal
from roughmap_schemas.kinds import Kind
from roughmap_schemas.wire import LENGTH, MAX_ENTRIES, entries
from roughmap_service.host.counters import OTHERS, Counters
from roughmap_service.host.log_lines import note
from roughmap_service.inputs.queue import InputMessage
from roughmap_service.inputs.streams import Streams
from roughmap_service.run.decoding import Content, decode
from roughmap_service.run.inbox import Inbox
from roughmap_service.run.settings import Settings

logger = logging.getLogger(__name__)

MAX_SHOWN = 500
"""Characters of a log line about a message: its content comes from outside."""

FRAME_FIELD: Final = PointCloud.DESCRIPTOR.fields_by_name["frame_id"].number


def admit(message: InputMessage, settings: Settings, known: Collection[str], inbox: Inbox) -> Content:
    """Decode a message and check it against the configuration; ``known`` are the robots that have sent before.

    Raises MessageFault if it must not be logged.
    """
    robots = settings.config.input.robots
    if robots and message.robot not in robots:
        raise MessageFault(Refusal.UNKNOWN_ROBOT, f"robot {message.robot!r} is not in input.robots")
    if not robots and message.robot not in known and len(known) >= (most := settings.max_robots):
        raise MessageFault(
            Refusal.UNKNOWN_ROBOT, f"{most} robots are known already (input.max_robots); name yours in input.robots"
        )
    try:
        content = decode(message.kind, message.payload, settings)
    except MemoryError:
        raise MessageFault(Refusal.BUSY, "not enough memory to decode the message; try again") from None
    if content.stamp_ns == 0 and (isinstance(content, Odometry) or _of_sensor(content, settings)):
        raise MessageFault(Refusal.UNSET_STAMP, "its stamp is 0, which means not set: fill in the header's stamp")
    if isinstance(content, Cloud):
        _check_cloud(message, content, settings, inbox)
    return content


def _of_sensor(content: Content, settings: Settings) -> bool:
    return isinstance(content, Cloud) and content.frame_id != settings.frame_id


def refuse(
    counters: Counters, streams: Streams, robot: str, kind: Kind, fault: MessageFault, payload: bytes = b""
) -> None:
    """Count a message that is not logged, and log a line about it: a few a minute for each robot and reason."""
    shown = counters.refuse(fault.code, robot)
    frame = frame_of(payload) if kind is Kind.POINTS else ""
    streams.refused(robot, frame or kind.value, fault.code, fault.message)
    if fault.code != Refusal.LOG_UNAVAILABLE:  # the log's writer has its own line for that
        source = "" if robot == OTHERS else f"robot {robot}{f' sensor {frame}' if frame else ''}: "
        text = f"{source}message refused, {fault.code}: {fault.message}"[:MAX_SHOWN]
        note(logger, logging.WARNING, "refused", text, robot=shown, reason=str(fault.code))


def frame_of(payload: bytes) -> str:
    """Return the frame of a cloud that may be broken; "" if it names none."""
    with suppress(MessageFault):
        for entry in islice(entries(payload, "a cloud", 0, len(payload)), MAX_ENTRIES):
            if (entry.number, entry.wire) == (FRAME_FIELD, LENGTH):
                return payload[entry.start : min(entry.end, entry.start + MAX_SHOWN)].decode("utf-8", "replace")
    return ""


def _check_cloud(message: InputMessage, cloud: Cloud, settings: Settings, inbox: Inbox) -> None:
    if cloud.frame_id != settings.frame_id and settings.sensor(message.robot, cloud.frame_id) is None:
        why = "" if cloud.frame_id else " (set frame_id)"
        raise MessageFault(
            Refusal.UNKNOWN_SENSOR,
            f"frame {cloud.frame_id!r} is neither the map's ({settings.frame_id!r}) nor a configured sensor{why}",
        )
    if message.reply is not None and not inbox.has_room(cloud.held_bytes):
        raise MessageFault(Refusal.BUSY, "clouds that wait for poses fill input.queue_limit; try again")
