"""ROS messages as mcap-ros2-support reads them: a decoder that is not roughmap's."""

from typing import Any

from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from roughmap_ros.messages import TYPES


def decoded_by_mcap(ros_type: str, cdr: bytes) -> Any:
    text = TYPES.generate_msgdef(ros_type, ros_version=2)[0]
    decoder = DecoderFactory().decoder_for("cdr", Schema(id=1, data=text.encode(), encoding="ros2msg", name=ros_type))
    assert decoder is not None
    return decoder(cdr)
