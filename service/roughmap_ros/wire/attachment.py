"""What rmw_zenoh sends beside each message, request and reply: 33 bytes, little-endian.

Sequence number (int64, from 1), source time (int64, ns), the length 16 (one byte), and the sender's gid (16 bytes).
"""

import struct
from typing import Final, NamedTuple

from roughmap_schemas.faults import ReportedError

LAYOUT: Final = struct.Struct("<qqB16s")
GID_SIZE: Final = 16
MAX_ATTACHMENT: Final = 1024
"""Bytes of an attachment that is looked at."""

OLD_NAME: Final = b"sequence_number"
"""The first field's name, which older versions of rmw_zenoh send too."""


class BadAttachment(ReportedError):
    """An attachment that is not as rmw_zenoh's; one line that says what was found."""


class Attachment(NamedTuple):
    """Sequence number, source time in ns, and gid of the sender (16 bytes)."""

    sequence: int
    source_ns: int
    gid: bytes


def pack_attachment(attachment: Attachment) -> bytes:
    """Return the 33 bytes."""
    return LAYOUT.pack(attachment.sequence, attachment.source_ns, GID_SIZE, attachment.gid)


def unpack_attachment(data: bytes) -> Attachment:
    """Read an attachment; raises BadAttachment."""
    if len(data) != LAYOUT.size:
        if OLD_NAME in data[:32]:
            raise BadAttachment(
                "an attachment with names of fields, as of rmw_zenoh before 0.1.2 (Humble), 0.2.4 (Jazzy) and 0.6.0 "
                "(Kilted): update rmw_zenoh"
            )
        raise BadAttachment(f"expected an attachment of rmw_zenoh with {LAYOUT.size} bytes; found {len(data)} bytes")
    sequence, source_ns, size, gid = LAYOUT.unpack(data)
    if size != GID_SIZE:
        raise BadAttachment(f"expected a gid of {GID_SIZE} bytes in rmw_zenoh's attachment; found {size}")
    return Attachment(sequence, source_ns, gid)
