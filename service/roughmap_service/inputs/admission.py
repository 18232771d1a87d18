"""What a message must be to be taken up: whole, from a known robot and sensor, and with room to wait."""

from collections.abc import Collection

from roughmap_schemas import Cloud, MessageFault, Refusal
from roughmap_service.inputs.queue import InputMessage
from roughmap_service.run.fold import Content, decode
from roughmap_service.run.inbox import Inbox
from roughmap_service.run.settings import Settings


def admit(message: InputMessage, settings: Settings, known: Collection[str], inbox: Inbox) -> Content:
    """Decode, and hold against the configuration what the bytes alone don't tell; ``known`` are the robots heard so
    far. Raises ``MessageFault``."""
    robots = settings.config.input.robots
    if robots and message.robot not in robots:
        raise MessageFault(Refusal.UNKNOWN_ROBOT, f"robot {message.robot!r} is not among input.robots")
    if not robots and message.robot not in known and len(known) >= (most := settings.max_robots):
        raise MessageFault(
            Refusal.UNKNOWN_ROBOT, f"{most} robots are known (input.max_robots); name yours in input.robots"
        )
    try:
        content = decode(message.kind, message.payload, settings)
    except MemoryError:
        raise MessageFault(Refusal.BUSY, "there is no memory to decode the message; try again") from None
    if isinstance(content, Cloud):
        _check_cloud(message, content, settings, inbox)
    return content


def _check_cloud(message: InputMessage, cloud: Cloud, settings: Settings, inbox: Inbox) -> None:
    if cloud.frame_id != settings.frame_id and settings.sensor(message.robot, cloud.frame_id) is None:
        where = f"[sensors.{cloud.frame_id}]" if cloud.frame_id else "set frame_id"
        raise MessageFault(
            Refusal.UNKNOWN_SENSOR,
            f"frame {cloud.frame_id!r} is neither the map's ({settings.frame_id!r}) nor a configured sensor ({where})",
        )
    if message.reply is not None and not inbox.has_room(cloud.held_bytes):
        raise MessageFault(Refusal.BUSY, "clouds wait for their poses up to input.queue_limit; try again")
