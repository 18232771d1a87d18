"""From the bytes of a message to its content."""

from roughmap_schemas import (
    Cloud,
    Odometry,
    Transform,
    decode_cloud,
    decode_odometry,
    decode_transform,
)
from roughmap_schemas.kinds import Kind
from roughmap_service.run.settings import Settings

Content = Cloud | Odometry | Transform


def decode(kind: Kind, payload: bytes, settings: Settings) -> Content:
    """Decode a cloud, an odometry or a transform. MessageFault if the bytes are not one, or it is too large."""
    inputs = settings.config.input
    if kind is Kind.POINTS:
        return decode_cloud(
            payload, max_message=inputs.max_message, max_points=inputs.max_points, map_frame=settings.frame_id
        )
    if kind is Kind.ODOMETRY:
        return decode_odometry(payload, max_message=inputs.max_message)
    return decode_transform(payload, max_message=inputs.max_message)
