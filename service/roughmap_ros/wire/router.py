"""Whether a Zenoh session stands in the way of ROS nodes that look for their router."""

import re
from collections.abc import Sequence
from typing import Final

from roughmap_ros.wire.keys import KeyStyle

ROS_PORT: Final = 7447
"""The TCP port on which nodes of rmw_zenoh expect a router."""

ENDPOINT: Final = re.compile(r"tcp/.*:(\d+)(?:[?#].*)?")

REMEDY: Final = (
    f'set zenoh.mode = "client", zenoh.listen = [] and zenoh.connect = ["tcp/127.0.0.1:{ROS_PORT}"] and run '
    'rmw_zenohd, or set zenoh.mode = "router" to be their router'
)


def router_problem(mode: str, listen: Sequence[str], keys: KeyStyle, *, scouting: bool = False) -> str | None:
    """Say how a session keeps ROS nodes from finding each other, or finds none itself; None if all is well.

    ``mode``, ``listen`` and ``scouting`` as in the section [zenoh]. ROS nodes are peers. They tell each other where
    they are through a router on port 7447, which carries messages for its clients only: between peers it passes
    addresses, by gossip, which a peer without scouting does not hear. Whatever else listens on that port takes the
    router's place, and tells nothing.
    """
    if keys != "rmw_zenoh" or mode != "peer":
        return None
    taken = [endpoint for endpoint in listen if (at := ENDPOINT.fullmatch(endpoint)) and int(at[1]) == ROS_PORT]
    if taken:
        return (
            f'zenoh.mode is "peer" and listens on {taken[0]}, where ROS nodes of rmw_zenoh look for their router: they '
            f"connect here and don't find each other; {REMEDY}"
        )
    if not scouting:
        return f'zenoh.mode is "peer" without scouting, which hears no ROS nodes through their router; {REMEDY}'
    return None
