"""The Zenoh encodings of payloads."""

from roughmap_schemas.faults import MessageFault
from roughmap_schemas.reasons import Refusal

POINT_CLOUD = "application/protobuf;foxglove.PointCloud"
ODOMETRY = "application/protobuf;foxglove.Odometry"
FRAME_TRANSFORM = "application/protobuf;foxglove.FrameTransform"
GRID = "application/protobuf;foxglove.Grid"

UNSAID = frozenset({"", "zenoh/bytes"})
"""What arrives if the publisher sets no encoding; the key then says what the payload is."""

PROTOBUF = "application/protobuf"
"""An encoding without its schema, such as Zenoh's own constant; the key says that too."""


def json_encoding(model: str) -> str:
    """Return the encoding of a JSON model, such as ``application/json;roughmap.TileInfo``."""
    return f"application/json;roughmap.{model}"


def check_encoding(given: str, expected: str) -> None:
    """Raise ``MessageFault`` (``bad_encoding``) unless ``given`` is ``expected``, lacks the schema, or is unset."""
    if given not in UNSAID and given != expected and not (given == PROTOBUF and expected.startswith(PROTOBUF)):
        raise MessageFault(Refusal.BAD_ENCODING, f"expected encoding {expected}, or none; found {given[:200]!r}")
