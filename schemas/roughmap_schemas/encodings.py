"""The encodings under which payloads travel."""

from roughmap_schemas.faults import MessageFault
from roughmap_schemas.reasons import Refusal

POINT_CLOUD = "application/protobuf;foxglove.PointCloud"
ODOMETRY = "application/protobuf;foxglove.Odometry"
FRAME_TRANSFORM = "application/protobuf;foxglove.FrameTransform"
GRID = "application/protobuf;foxglove.Grid"

UNSAID = frozenset({"", "zenoh/bytes"})
"""What a publisher that sets no encoding sends: the key alone says what the payload is."""


def json_encoding(model: str) -> str:
    """Give the encoding of the JSON model of that name, e.g. ``application/json;roughmap.TileInfo``."""
    return f"application/json;roughmap.{model}"


def check_encoding(given: str, expected: str) -> None:
    """Raise ``MessageFault`` (``bad_encoding``) unless ``given`` is the expected one or was left unsaid."""
    if given not in UNSAID and given != expected:
        raise MessageFault(Refusal.BAD_ENCODING, f"expected the encoding {expected}, or none; found {given[:200]!r}")
