"""Checks a protobuf payload's outline before it is parsed.

Protobuf parses most payloads of another message type without an error: fields with an unexpected wire type count as
unknown, and the rest keep their defaults. The outline shows such a payload. It also bounds the number of entries before
the parser makes an object of each.
"""

from collections.abc import Iterator
from functools import cache
from typing import Any, Final, NamedTuple, TypeVar

from google.protobuf.message import DecodeError, Message

from roughmap_schemas.faults import bad_message, too_large

MAX_ENTRIES: Final = 4096
"""Entries of a message, including nested ones. A cloud has about forty, odometry with metadata a few hundred."""

VARINT, FIXED64, LENGTH, FIXED32 = 0, 1, 2, 5

WIRE_OF_TYPE: Final = {1: 1, 2: 5, 3: 0, 4: 0, 5: 0, 6: 1, 7: 5, 8: 0, 9: 2, 11: 2, 12: 2, 13: 0, 14: 0, 15: 5, 16: 1}
"""The wire type of each ``FieldDescriptor.type``; the zigzag types 17 and 18 are varints too."""

P = TypeVar("P", bound=Message)


class Entry(NamedTuple):
    """One field of a payload: number, wire type, and where its tag begins and its value begins and ends."""

    number: int
    wire: int
    tag: int
    start: int
    end: int


def entries(payload: bytes, what: str, start: int, end: int) -> Iterator[Entry]:
    """Yield the entries of the message in ``payload[start:end]``; raises ``MessageFault`` at the first invalid one."""
    at = start
    while at < end:
        tag = at
        if (key := payload[at]) < 0x80:  # as most are
            at += 1
        else:
            key, at = _varint(payload, what, at, end)
        number, wire = key >> 3, key & 7
        if wire == VARINT:
            value = at
            _, at = _varint(payload, what, at, end)
        elif wire == FIXED64:
            value, at = at, at + 8
        elif wire == FIXED32:
            value, at = at, at + 4
        elif wire == LENGTH:
            if at < end and (length := payload[at]) < 0x80:
                value = at + 1
            else:
                length, value = _varint(payload, what, at, end)
            at = value + length
        else:
            raise bad_message(f"expected {what}; found no protobuf message (wire type {wire} at byte {tag})")
        if at > end:
            raise bad_message(f"expected {what}; found it cut off: {at - end} bytes are missing at byte {end}")
        if number == 0:
            raise bad_message(f"expected {what}; found no protobuf message (field number 0 at byte {tag})")
        yield Entry(number, wire, tag, value, at)


def _varint(payload: bytes, what: str, at: int, end: int) -> tuple[int, int]:
    value = shift = 0
    while at < end and shift < 70:
        byte = payload[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
    found = "it cut off in a number" if at >= end else "a number of more than ten bytes"
    raise bad_message(f"expected {what}; found {found} at byte {at}")


def write_varint(value: int) -> bytes:
    """Return a number from 0 as a protobuf varint: seven bits per byte, the lowest first."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


class _Outline(NamedTuple):
    """The wire types of a message's fields."""

    name: str
    wires: dict[int, tuple[int, ...]]
    nested: dict[int, "_Outline"]


@cache
def _outline_of(descriptor: Any) -> _Outline:
    wires: dict[int, tuple[int, ...]] = {}
    nested: dict[int, _Outline] = {}
    for field in descriptor.fields:
        wire = WIRE_OF_TYPE.get(field.type, VARINT)
        # Numbers in a repeated field may come packed as one entry.
        wires[field.number] = (wire, LENGTH) if field.is_repeated and wire != LENGTH else (wire,)
        if field.message_type is not None:
            nested[field.number] = _outline_of(field.message_type)
    return _Outline(descriptor.full_name, wires, nested)


def check_outline(payload: bytes, kind: type[Message]) -> list[Entry]:
    """Walk a whole payload and return its top-level entries.

    Raises ``MessageFault``: ``bad_message`` if it is cut off, is not protobuf, or has a field of this schema with
    another wire type; ``too_large`` for more than ``MAX_ENTRIES`` entries. Fields outside the schema are ignored.
    """
    outline = _outline_of(kind.DESCRIPTOR)
    top: list[Entry] = []
    seen = 0
    waiting = [(outline, 0, len(payload))]
    while waiting:
        level, start, end = waiting.pop()
        for entry in entries(payload, outline.name, start, end):
            seen += 1
            if seen > MAX_ENTRIES:
                raise too_large(f"{outline.name}: expected at most {MAX_ENTRIES} entries; found more")
            allowed = level.wires.get(entry.number)
            if allowed is not None and entry.wire not in allowed:
                raise bad_message(
                    f"expected {outline.name}; found another message (field {entry.number} of {level.name} has "
                    f"wire type {entry.wire}, not {allowed[0]})"
                )
            if entry.number in level.nested:
                waiting.append((level.nested[entry.number], entry.start, entry.end))
            if level is outline:
                top.append(entry)
    return top


def check_size(payload: bytes, what: str, max_message: int) -> None:
    """Raise ``MessageFault`` (``too_large``) for a payload over ``max_message`` bytes."""
    if len(payload) > max_message:
        raise too_large(f"{what}: expected at most {max_message} bytes; found {len(payload)}")


def parse(payload: bytes, kind: type[P]) -> P:
    """Parse a payload whose outline was checked; raises ``MessageFault`` (``bad_message``)."""
    message = kind()
    try:
        message.ParseFromString(payload)
    except DecodeError as error:
        detail = str(error).splitlines()[0][:120] if str(error) else "it doesn't parse"
        raise bad_message(f"expected {kind.DESCRIPTOR.full_name}; found {detail}") from None
    return message
