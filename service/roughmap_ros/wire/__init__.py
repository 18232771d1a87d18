"""ROS 2 over a Zenoh session, without ROS: keys, tokens and attachments as two bridges of ROS to Zenoh use them.

keys.py         data keys of rmw_zenoh and zenoh-bridge-ros2dds
qos.py          quality of service, as text in tokens and in words
tokens.py       liveliness tokens, by which nodes see each other
attachment.py   what rmw_zenoh sends beside each message
node.py         `RosNode`: a node with publishers, subscribers and services
publisher.py, subscriber.py, services.py   its endpoints
matching.py     which endpoints of other nodes don't fit ours, in words
refusals.py     messages that were refused, counted by reason
router.py       what a Zenoh session needs beside ROS nodes

`RosNode` alone knows Zenoh sessions; all else takes and gives plain values.
"""

from roughmap_ros.wire.node import RosNode
from roughmap_ros.wire.publisher import RosPublisher, enable_timestamps
from roughmap_ros.wire.qos import SENSOR_DATA, Qos
from roughmap_ros.wire.router import router_problem
from roughmap_ros.wire.subscriber import Received
from roughmap_ros.wire.tokens import Entity, Kind

__all__ = [
    "SENSOR_DATA",
    "Entity",
    "Kind",
    "Qos",
    "Received",
    "RosNode",
    "RosPublisher",
    "enable_timestamps",
    "router_problem",
]
