"""Which endpoints of other nodes don't fit ours, in words."""

from collections.abc import Iterable, Sequence
from typing import Final

from roughmap_ros.wire.qos import durability, reliability
from roughmap_ros.wire.tokens import Entity, Kind

NO_HASH: Final = "TypeHashNotSupported"
"""What rmw_zenoh of ROS 2 Humble writes for a type hash."""

NO_HASH_TEXT: Final = (
    f"{NO_HASH}: rmw_zenoh of ROS 2 Humble, which does not say which message it sends; use zenoh-bridge-ros2dds and "
    'ros2.keys = "ros2dds" with Humble'
)

OPPOSITE: Final = {
    Kind.PUBLISHER: Kind.SUBSCRIBER,
    Kind.SUBSCRIBER: Kind.PUBLISHER,
    Kind.SERVICE: Kind.CLIENT,
    Kind.CLIENT: Kind.SERVICE,
}

WORD: Final = {
    Kind.PUBLISHER: "publisher",
    Kind.SUBSCRIBER: "subscriber",
    Kind.SERVICE: "service",
    Kind.CLIENT: "client",
}

MAX_NAMED: Final = 5
"""Topics and nodes that one line names."""


def mismatches(ours: Sequence[Entity], others: Sequence[Entity]) -> list[str]:
    """Return a line for each endpoint of another node that does not fit ours, sorted; it begins with the topic."""
    return sorted({line for own in ours for other in others if (line := mismatch(own, other)) is not None})


def unpublished(ours: Sequence[Entity], others: Sequence[Entity]) -> list[str]:
    """Return a line for each of our subscribers without a publisher, sorted; it begins with the topic."""
    return sorted({line for own in ours if (line := _unpublished(own, others)) is not None})


def mismatch(own: Entity, other: Entity) -> str | None:
    """Say how an endpoint of another node does not fit one of ours; None if it fits, or has nothing to do with it."""
    if own.topic != other.topic or OPPOSITE.get(own.kind) != other.kind:
        return None
    who = f"{own.topic}: a {WORD[other.kind]} ({other.node})"
    if other.ros_type != own.ros_type:
        return f"{who} has another type: {other.ros_type}; expected {own.ros_type}"
    if other.type_hash == NO_HASH:
        return f"{who} has the type hash {NO_HASH_TEXT}"
    if other.type_hash != own.type_hash:
        return f"{who}: {hash_text(own.ros_type, other.type_hash, own.type_hash)}"
    if own.kind == Kind.SUBSCRIBER:
        missing = _unmet(other, own)
        return missing and f"{who} offers {other.qos.words}; we ask for {missing}"
    if own.kind == Kind.PUBLISHER:
        missing = _unmet(own, other)
        return missing and f"{who} asks for {missing}; we offer {own.qos.words}"
    return None


def hash_text(ros_type: str, found: str, expected: str) -> str:
    """Say that a type hash is of another definition."""
    return f"hash {found[:80]} differs: another version of {ros_type}; expected {expected}"


def _unmet(publisher: Entity, subscriber: Entity) -> str | None:
    """Name the policies for which a subscriber asks more than the publisher offers."""
    offered, asked = publisher.qos, subscriber.qos
    unmet = [reliability(asked.reliable)] if asked.reliable > offered.reliable else []
    unmet += [durability(asked.transient_local)] if asked.transient_local > offered.transient_local else []
    return " ".join(unmet) or None


def _unpublished(own: Entity, others: Iterable[Entity]) -> str | None:
    """Name the topics that a subscriber could have meant, if no node publishes its own."""
    if own.kind != Kind.SUBSCRIBER:
        return None
    published = [other for other in others if other.kind == Kind.PUBLISHER]
    if any(other.topic == own.topic for other in published):
        return None
    alike = sorted({other.topic for other in published if other.ros_type == own.ros_type})
    found = ", ".join(alike[:MAX_NAMED]) + (", ..." if len(alike) > MAX_NAMED else "")
    return f"{own.topic}: no node publishes it" + (f"; {own.ros_type} is on {found}" if found else "")
