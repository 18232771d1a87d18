"""Events: every change of the map and every decision on a cloud, as logged and published."""

import json
from typing import Annotated, Final, Literal

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from roughmap_schemas.faults import UnknownEventKind
from roughmap_schemas.messages import BadJson, Hex32, Message, Number, model_bytes
from roughmap_schemas.reasons import CloudReason, PointReason

Input = Annotated[int, Field(ge=1)]


class _Closed(Message):
    """The base of events. They take no unknown members: a replay must account for everything that an event says."""

    model_config = ConfigDict(extra="forbid")


class IntegrationEvent(_Closed):
    """The decision on one cloud.

    ``poses`` are (odometry input, transform input or 0), ascending by stamp; replay places the cloud with exactly
    these. ``sequence`` is the map's after the event, one higher than before if ``accepted`` is at least 1. ``cleared``
    counts the bins of 5 cm that the scan saw through, whose hits were halved.
    """

    kind: Literal["integration"] = "integration"
    epoch: Number
    input: Input
    robot: str
    poses: list[tuple[Input, Number]]
    outcome: Literal["integrated"] | CloudReason
    accepted: Number
    rejected: dict[PointReason, Number]
    sequence: Number
    cleared: Number = 0


class CheckpointEvent(_Closed):
    """The map's digest at a sequence."""

    kind: Literal["checkpoint"] = "checkpoint"
    epoch: Number
    sequence: Number
    digest: Hex32


class ResetEvent(_Closed):
    """The map was emptied; ``epoch`` and ``sequence`` are the new ones."""

    kind: Literal["reset"] = "reset"
    epoch: Number
    sequence: Number


class ForgetEvent(_Closed):
    """Tiles were erased; ``sequence`` is the map's after it. Tiles ascend by (x, y)."""

    kind: Literal["forget"] = "forget"
    epoch: Number
    sequence: Number
    tiles: Annotated[list[tuple[int, int]], Field(min_length=1)]


class SensorTimeEvent(_Closed):
    """How the times of a sensor's points are read, from this event on.

    ``field`` names the clouds' time field ("" for none). ``unit`` is that of its values; they count from the cloud's
    stamp ("start"), backwards from it ("end", values may be negative) or from the epoch ("absolute").
    """

    kind: Literal["sensor_time"] = "sensor_time"
    epoch: Number
    robot: str
    frame_id: str
    field: str
    unit: Literal["s", "ms", "us", "ns"]
    origin: Literal["start", "end", "absolute"]
    sequence: Number


Event = IntegrationEvent | CheckpointEvent | ResetEvent | ForgetEvent | SensorTimeEvent

EVENT: Final[TypeAdapter[Event]] = TypeAdapter(Annotated[Event, Field(discriminator="kind")])
KINDS: Final = ("integration", "checkpoint", "reset", "forget", "sensor_time")
"""``edit`` and ``remap`` are reserved for later versions, and unknown to this one."""


def encode_event(event: Event) -> bytes:
    """Return the event's JSON, ``kind`` first."""
    return model_bytes(event)


def decode_event(payload: bytes) -> Event:
    """Read an event; raises ``UnknownEventKind``, or ``BadJson`` if it is not an event."""
    try:
        return EVENT.validate_json(payload)
    except ValidationError as error:
        kind = _kind(payload)
        if kind is not None and kind not in KINDS:
            raise UnknownEventKind(kind) from None
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"]) or "it"
        raise BadJson(f"expected an Event in JSON: {where}: {first['msg']}") from None


def _kind(payload: bytes) -> str | None:
    try:
        value = json.loads(payload)
    except (ValueError, RecursionError):
        return None
    kind = value.get("kind") if isinstance(value, dict) else None
    return kind if isinstance(kind, str) else None
