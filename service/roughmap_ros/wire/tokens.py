"""Liveliness tokens: by them nodes see each other's publishers, subscribers, services and clients.

rmw_zenoh: ``@ros2_lv/<domain>/<Zenoh id>/<node id>/<id>/<kind>/<enclave>/<namespace>/<node>``, and for all but nodes
``/<topic>/<type>/<type hash>/<qos>``; slashes in names are written as %, a node's own id is its node id.
zenoh-bridge-ros2dds: ``@/<Zenoh id>/@ros2_lv/<kind>/<topic>/<type>[/<qos>]``, slashes as §.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import xxhash

from roughmap_ros.wire.keys import DOMAIN, bridge_key, dds_name, ros_name
from roughmap_ros.wire.qos import Qos, bridge_qos_text, parse_qos

PREFIX: Final = "@ros2_lv"
MAX_TOKEN: Final = 4096
"""Characters of a token that is read."""


class Kind(StrEnum):
    """What a token stands for."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIBER = "MS"
    SERVICE = "SS"
    CLIENT = "SC"


@dataclass(frozen=True, slots=True)
class Entity:
    """A node, or an endpoint of one: then ``topic`` (absolute), ``ros_type``, ``type_hash`` and ``qos_text`` are set.

    ``zid`` is the Zenoh id of its session. ``namespace`` is "/" or absolute.
    """

    kind: Kind
    domain: int
    zid: str
    node_id: int
    id: int
    namespace: str
    name: str
    topic: str = ""
    ros_type: str = ""
    type_hash: str = ""
    qos_text: str = ""
    enclave: str = "/"

    @property
    def node(self) -> str:
        """The node's full name, such as /robot/driver."""
        return f"{self.namespace.rstrip('/')}/{self.name}"

    @property
    def qos(self) -> Qos:
        """Its quality of service."""
        return parse_qos(self.qos_text) or Qos()

    @property
    def token(self) -> str:
        """The key of its token with rmw_zenoh."""
        head = f"{PREFIX}/{self.domain}/{self.zid}/{self.node_id}/{self.id}/{self.kind}"
        node = f"{head}/{_mangle(self.enclave)}/{_mangle(self.namespace)}/{self.name}"
        if self.kind == Kind.NODE:
            return node
        return f"{node}/{_mangle(self.topic)}/{dds_name(self.ros_type)}/{self.type_hash}/{self.qos_text}"

    @property
    def gid(self) -> bytes:
        """The 16 bytes by which its messages name it: XXH3-128 of the token, the low 64 bits first, little-endian."""
        return xxhash.xxh3_128_digest(self.token.encode())[::-1]


def all_tokens(domain: int) -> str:
    """Return the key expression of all tokens of rmw_zenoh in a domain."""
    return f"{PREFIX}/{domain}/**"


def parse_token(text: str) -> Entity | None:
    """Read a token of rmw_zenoh; None if it is none. Parts that newer versions append are passed over."""
    if len(text) > MAX_TOKEN or not text.isprintable():  # names go into log lines and onto terminals
        return None
    parts = text.split("/")
    if len(parts) < 9 or parts[0] != PREFIX or "" in parts[:9] or parts[5] not in set(Kind):
        return None
    numbers = (parts[1], parts[3], parts[4])
    if DOMAIN.fullmatch(parts[1]) is None or not all(n.isascii() and n.isdecimal() and len(n) <= 20 for n in numbers):
        return None
    kind, domain, node_id, own_id = Kind(parts[5]), *map(int, numbers)
    enclave, namespace, name = _demangle(parts[6]), _demangle(parts[7]), parts[8]
    if kind == Kind.NODE:
        return Entity(kind, domain, parts[2], node_id, own_id, namespace, name, enclave=enclave)
    if len(parts) < 13:
        return None
    topic, ros_type, type_hash, qos = _demangle(parts[9]), ros_name(parts[10]), parts[11], parts[12]
    if ros_type is None or not type_hash or parse_qos(qos) is None:
        return None
    return Entity(
        kind, domain, parts[2], node_id, own_id, namespace, name, topic, ros_type, type_hash, qos, enclave=enclave
    )


def bridge_token(kind: Kind, zid: str, topic: str, ros_type: str, qos: Qos) -> str:
    """Return the token by which zenoh-bridge-ros2dds learns of a publisher or service that no other bridge announces.

    It calls a service of which it has seen no token only in its newest versions.
    """
    head = f"@/{zid}/{PREFIX}/{kind}/{bridge_key(topic).replace('/', '§')}/{ros_type.replace('/', '§')}"
    return head if kind in {Kind.SERVICE, Kind.CLIENT} else f"{head}/{bridge_qos_text(qos)}"


def _mangle(name: str) -> str:
    return name.replace("/", "%")


def _demangle(name: str) -> str:
    return name.replace("%", "/")
