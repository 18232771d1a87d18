"""Whether a Zenoh session stands in the way of ROS nodes that look for their router."""

import re
from collections.abc import Sequence
from typing import Final

from roughmap_ros.wire.keys import KeyStyle

ROS_PORT: Final = 7447
"""The TCP port on which nodes of rmw_zenoh expect a router."""

ENDPOINT: Final = re.compile(r"tcp/.*:(\d+)(?:[?#].*)?")


def router_problem(mode: str, listen: Sequence[str], keys: KeyStyle) -> str | None:
    """Say how a session keeps ROS nodes from finding each other, None if it doesn't.

    ``mode`` and ``listen`` are the session's mode and the endpoints on which it listens. ROS nodes tell each other
    where they are through a router on port 7447; whatever else listens there takes its place, and tells nothing.
    """
    if keys != "rmw_zenoh" or mode != "peer":
        return None
    taken = [endpoint for endpoint in listen if (at := ENDPOINT.fullmatch(endpoint)) and int(at[1]) == ROS_PORT]
    if not taken:
        return None
    return (
        f'zenoh.mode is "peer" and listens on {taken[0]}, where ROS nodes of rmw_zenoh look for their router: they '
        f'connect here and don\'t find each other; set zenoh.mode = "router", or zenoh.mode = "client" with '
        f'zenoh.connect = ["tcp/127.0.0.1:{ROS_PORT}"] and run rmw_zenohd'
    )
