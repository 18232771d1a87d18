"""Keys, tokens and attachments are those that a real node of rmw_zenoh (Kilted) sent, byte for byte."""

import json
from pathlib import Path
from typing import Any

import pytest

from roughmap_ros.wire import SENSOR_DATA, Entity, Kind, Qos
from roughmap_ros.wire.attachment import pack_attachment, unpack_attachment
from roughmap_ros.wire.keys import DataKey
from roughmap_ros.wire.qos import qos_text
from roughmap_ros.wire.tokens import parse_token

ZID = "fe046ee4134fae660119c5863bb22c68"
QOS = {  # as the recorded node was written; parameters' profiles are ROS's own
    "/points": SENSOR_DATA,
    "/rover/odom": Qos(),
    "/roughmap/grid": Qos(transient_local=True, depth=1),
    "/ros_map": Qos(transient_local=True, depth=1),
    "/ros_odom": Qos(),
    "/ros_points": SENSOR_DATA,
    "/roughmap/get_map": Qos(),
    "/parameter_events": Qos(depth=1000),
    "/real_ros/get_parameters": Qos(depth=1000),
}


@pytest.fixture(scope="module")
def node(recordings: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((recordings / "ros2" / "rmw_zenoh_kilted.json").read_text())
    return content


def entities(node: dict[str, Any]) -> list[Entity]:
    found = [parse_token(text) for text in node["tokens"]]
    assert None not in found
    return [entity for entity in found if entity is not None]


def test_all_tokens_are_read_and_written_again(node: dict[str, Any]) -> None:
    assert len(node["tokens"]) == 17
    assert [entity.token for entity in entities(node)] == node["tokens"]


def test_tokens_are_those_of_the_node_and_its_endpoints(node: dict[str, Any]) -> None:
    assert {(entity.node, entity.zid, entity.domain) for entity in entities(node)} == {("/real_ros", ZID, 0)}
    kinds = [entity.kind for entity in entities(node)]
    counted = {kind: kinds.count(kind) for kind in Kind}
    assert counted == {Kind.NODE: 1, Kind.PUBLISHER: 5, Kind.SUBSCRIBER: 3, Kind.SERVICE: 7, Kind.CLIENT: 1}


def test_the_text_of_its_qos_is_ours(node: dict[str, Any]) -> None:
    recorded = {entity.topic: entity.qos_text for entity in entities(node)}
    assert {topic: qos_text(qos) for topic, qos in QOS.items()} == {topic: recorded[topic] for topic in QOS}


def test_an_endpoint_that_is_made_has_the_recorded_token(node: dict[str, Any]) -> None:
    hashed = "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"
    made = Entity(
        Kind.PUBLISHER, 0, ZID, 0, 15, "/", "real_ros", "/ros_points", "sensor_msgs/msg/PointCloud2", hashed,
        qos_text(SENSOR_DATA),
    )  # fmt: skip
    assert made.token in node["tokens"]


@pytest.mark.parametrize("name", ["ros_map", "ros_odom", "ros_points"])
def test_a_sample_has_the_key_and_gid_of_its_publisher(node: dict[str, Any], name: str) -> None:
    sample = node["samples"][name]
    (publisher,) = [entity for entity in entities(node) if entity.topic == f"/{name}"]
    assert DataKey(0, publisher.topic, publisher.ros_type, publisher.type_hash).text == sample["key"]
    attachment = unpack_attachment(bytes.fromhex(sample["attachment"]))
    assert attachment.gid == publisher.gid
    assert attachment.sequence == 1
    assert pack_attachment(attachment).hex() == sample["attachment"]


def test_a_request_has_the_key_and_gid_of_its_client(node: dict[str, Any]) -> None:
    (client,) = [entity for entity in entities(node) if entity.kind == Kind.CLIENT]
    request = node["service"]
    assert DataKey(0, client.topic, client.ros_type, client.type_hash).text == request["key"]
    attachment = unpack_attachment(bytes.fromhex(request["attachment"]))
    assert (attachment.sequence, attachment.gid) == (1, client.gid)
    assert pack_attachment(attachment).hex() == request["attachment"]
