"""Quality of service: as text in liveliness tokens, and in words."""

from typing import Final, NamedTuple

RMW_DEPTH: Final = 42
"""The depth that rmw_zenoh leaves out of its text."""


class Qos(NamedTuple):
    """Quality of service of a publisher or subscriber; ``depth`` 0 keeps all messages."""

    reliable: bool = True
    transient_local: bool = False
    depth: int = 10

    @property
    def words(self) -> str:
        """The policies that must match, such as "best_effort volatile"."""
        return f"{reliability(self.reliable)} {durability(self.transient_local)}"


SENSOR_DATA: Final = Qos(reliable=False, depth=5)
"""ROS's profile for sensors."""

SERVICE: Final = Qos()


def reliability(reliable: bool) -> str:
    """Return ROS's word."""
    return "reliable" if reliable else "best_effort"


def durability(transient_local: bool) -> str:
    """Return ROS's word."""
    return "transient_local" if transient_local else "volatile"


def qos_text(qos: Qos) -> str:
    """Return the text in a token of rmw_zenoh: reliability:durability:history,depth:deadline:lifespan:liveliness.

    Defaults (reliable 1, volatile 2, keep last 1, depth 42, no times) are left out.
    """
    history = "2,0" if qos.depth == 0 else "," if qos.depth == RMW_DEPTH else f",{qos.depth}"
    return f"{'' if qos.reliable else '2'}:{'1' if qos.transient_local else ''}:{history}:,:,:,,"


def parse_qos(text: str) -> Qos | None:
    """Read the text of a token of rmw_zenoh, None if it is none. Deadline, lifespan and liveliness are passed over."""
    parts = text.split(":")
    if len(parts) < 3:
        return None
    history, comma, depth = parts[2].partition(",")
    if not comma or not all(_short_number(one) for one in (parts[0], parts[1], history)):
        return None
    if depth and not (depth.isascii() and depth.isdecimal() and len(depth) <= 20):
        return None
    kept = 0 if history == "2" else int(depth) if depth else RMW_DEPTH
    return Qos(reliable=parts[0] != "2", transient_local=parts[1] == "1", depth=kept)


def bridge_qos_text(qos: Qos) -> str:
    """Return the text in a token of zenoh-bridge-ros2dds: key:reliability:durability:history,depth, numbered as in DDS.

    A type without key fields leaves the first part empty.
    """
    history = "1,0" if qos.depth == 0 else f"0,{qos.depth}"
    return f":{int(qos.reliable)}:{int(qos.transient_local)}:{history}"


def _short_number(text: str) -> bool:
    return not text or (len(text) == 1 and text.isascii() and text.isdecimal())
