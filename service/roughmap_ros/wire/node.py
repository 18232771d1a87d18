"""`RosNode`: what other ROS nodes take for a node, on a Zenoh session."""

import itertools
import re
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Final, Self

import zenoh

from roughmap_ros.wire.errors import zenoh_errors
from roughmap_ros.wire.keys import DataKey, KeyStyle, bridge_key, check_name, dds_name
from roughmap_ros.wire.matching import mismatches, unpublished
from roughmap_ros.wire.publisher import RosPublisher
from roughmap_ros.wire.qos import SERVICE, Qos, qos_text
from roughmap_ros.wire.refusals import Refusals
from roughmap_ros.wire.services import Service, Services
from roughmap_ros.wire.subscriber import Intake, Received, subscribe
from roughmap_ros.wire.tokens import Entity, Kind, all_tokens, bridge_token, parse_token

MAX_MESSAGE: Final = 64 << 20
"""Bytes of a message, unless told otherwise: the default of input.max_message."""

MAX_SEEN: Final = 20_000
"""Endpoints that are looked at."""

SEEN_TIMEOUT_S: Final = 5.0
"""How long the answer about all nodes may take. Normally it takes milliseconds."""

NODE_ID: Final = 0


class RosNode:
    """A ROS node with the keys of rmw_zenoh or zenoh-bridge-ros2dds; a context manager that undeclares all of it.

    One node a session. Types are named as in sensor_msgs/msg/PointCloud2, topics and services absolutely. Messages of
    more than ``max_message`` bytes are refused before they are copied. For bad names all methods raise ValueError, and
    WireError if Zenoh refuses.
    """

    def __init__(
        self,
        session: zenoh.Session,
        name: str,
        *,
        keys: KeyStyle,
        domain: int = 0,
        namespace: str = "/",
        max_message: int = MAX_MESSAGE,
    ) -> None:
        if re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII) is None:
            raise ValueError(f"expected a node's name of letters, digits and _; found {name!r:.200}")
        self._session = session
        self._name = name
        self._rmw = keys == "rmw_zenoh"
        self._domain = domain
        self._namespace = namespace if namespace == "/" else check_name(namespace)
        self._max_message = max_message
        self._zid = str(session.zid())
        self._ids = itertools.count(1)
        self._ours: list[Entity] = []
        self._undeclare: list[Callable[[], object]] = []
        self._refusals = Refusals()
        self._services = Services(self._refusals)
        if self._rmw:
            node = Entity(Kind.NODE, domain, self._zid, NODE_ID, NODE_ID, self._namespace, name)
            self._declare_token(name, node.token)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Undeclare all endpoints, and the node last."""
        while self._undeclare:
            self._undeclare.pop()()
        self._services.close()

    def publisher(self, topic: str, ros_type: str, type_hash: str, qos: Qos) -> RosPublisher:
        """Return a publisher of a topic. For transient_local, open the session with `enable_timestamps`."""
        own = self._endpoint(Kind.PUBLISHER, topic, ros_type, type_hash, qos)
        publisher = RosPublisher(self._session, self._key(own), topic, qos, own.gid if self._rmw else None)
        self._undeclare.append(publisher.undeclare)
        self._announce(own)
        return publisher

    def subscriber(
        self, topic: str, ros_type: str, type_hash: str, qos: Qos, callback: Callable[[Received], None]
    ) -> None:
        """Subscribe a topic. ``callback`` gets each message in a thread of Zenoh's and must return at once.

        A ReportedError that it raises counts as a refusal. Messages with another type hash are refused by name.
        """
        own = self._endpoint(Kind.SUBSCRIBER, topic, ros_type, type_hash, qos)
        if self._rmw:
            self._announce(own)  # first: newer versions choose their keys by what the tokens of subscribers say
        expected = type_hash if self._rmw else None
        intake = Intake(topic, ros_type, expected, self._max_message, self._refusals, callback)
        key = DataKey(self._domain, topic, ros_type, "*").text if self._rmw else bridge_key(topic)
        self._undeclare.append(subscribe(self._session, key, qos, intake))

    def service(self, name: str, ros_type: str, type_hash: str, handler: Callable[[bytes], bytes]) -> None:
        """Offer a service. ``handler`` gets a request's CDR and returns the reply's, in a thread of the services.

        A ReportedError that it raises goes to the asker as an error, and counts as a refusal.
        """
        own = self._endpoint(Kind.SERVICE, name, ros_type, type_hash, SERVICE)
        service = Service(name, self._key(own), self._rmw, handler)
        self._undeclare.append(self._services.declare(self._session, service))
        self._announce(own)

    def seen(self) -> list[Entity]:
        """Return the publishers, subscribers, services and clients of other nodes, sorted; none with ros2dds.

        Not for callbacks: it waits until Zenoh has answered.
        """
        if not self._rmw:
            return []
        return [entity for entity in endpoints_seen(self._session, self._domain) if not self._is_own(entity)]

    def mismatches(self) -> list[str]:
        """Return a line for each endpoint of other nodes that does not fit ours. As `seen`, not for callbacks."""
        return mismatches(self._ours, self.seen())

    def unpublished(self) -> list[str]:
        """Return a line for each subscribed topic that no other node publishes; none with ros2dds. As `seen`."""
        return unpublished(self._ours, self.seen()) if self._rmw else []

    @property
    def refused(self) -> dict[tuple[str, str], int]:
        """Counts of refused messages and requests by topic and reason."""
        return self._refusals.counts

    def _is_own(self, entity: Entity) -> bool:
        return (entity.zid, entity.namespace, entity.name) == (self._zid, self._namespace, self._name)

    def _endpoint(self, kind: Kind, topic: str, ros_type: str, type_hash: str, qos: Qos) -> Entity:
        """Number an endpoint; raises ValueError for bad names."""
        check_name(topic)
        dds_name(ros_type)
        return Entity(
            kind, self._domain, self._zid, NODE_ID, next(self._ids), self._namespace, self._name,
            topic, ros_type, type_hash, qos_text(qos),
        )  # fmt: skip

    def _key(self, own: Entity) -> str:
        if self._rmw:
            return DataKey(self._domain, own.topic, own.ros_type, own.type_hash).text
        return bridge_key(own.topic)

    def _announce(self, own: Entity) -> None:
        """Declare an endpoint's token. A bridge needs none of subscribers: it sends what a matching one asks for."""
        self._ours.append(own)
        token = own.token if self._rmw else bridge_token(own.kind, self._zid, own.topic, own.ros_type, own.qos)
        self._declare_token(own.topic, token)

    def _declare_token(self, name: str, token: str) -> None:
        with zenoh_errors(name):
            self._undeclare.append(self._session.liveliness().declare_token(token).undeclare)


def endpoints_seen(session: zenoh.Session, domain: int) -> list[Entity]:
    """Return the publishers, subscribers, services and clients of all nodes of rmw_zenoh in a domain, sorted.

    Takes no node of one's own. Not for callbacks. Raises WireError.
    """
    keys: list[str] = []
    ended = threading.Event()

    def take(reply: zenoh.Reply) -> None:
        if reply.ok is not None and len(keys) < MAX_SEEN:
            keys.append(str(reply.ok.key_expr))

    # Zenoh replies with the tokens that it knows before `get` returns: a channel of theirs would fill up and hang.
    handler = zenoh.handlers.Callback(take, ended.set, indirect=False)
    with zenoh_errors(f"ROS domain {domain}"):
        session.liveliness().get(all_tokens(domain), handler, timeout=SEEN_TIMEOUT_S)
        ended.wait(SEEN_TIMEOUT_S + 1.0)
    found = {entity.token: entity for key in list(keys) if (entity := parse_token(key)) is not None}
    return [found[token] for token in sorted(found) if found[token].kind != Kind.NODE]
