"""Keys, tokens, QoS and attachments: what is written by hand here comes out, and goes back in."""

import struct
from string import ascii_letters, digits

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap_ros.wire import SENSOR_DATA, Entity, Kind, Qos
from roughmap_ros.wire.attachment import Attachment, BadAttachment, pack_attachment, unpack_attachment
from roughmap_ros.wire.keys import DataKey, bridge_key, check_name, dds_name, ros_name
from roughmap_ros.wire.qos import bridge_qos_text, parse_qos, qos_text
from roughmap_ros.wire.tokens import bridge_token, parse_token

HASH = "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"
POINTS = f"0/robot/points/sensor_msgs::msg::dds_::PointCloud2_/{HASH}"

WORD = st.text(ascii_letters + digits + "_", min_size=1, max_size=12).map(lambda text: "a" + text)
PATH = st.lists(WORD, min_size=1, max_size=4).map(lambda words: "/" + "/".join(words))
TYPE = st.tuples(WORD, st.sampled_from(["msg", "srv"]), WORD).map("/".join)
QOS = st.builds(Qos, st.booleans(), st.booleans(), st.integers(0, 10_000))
NODES = st.builds(
    Entity,
    st.just(Kind.NODE),
    st.integers(0, 232),
    st.text("0123456789abcdef", min_size=1, max_size=32),
    st.integers(0, 99),
    st.integers(0, 9999),
    PATH | st.just("/"),
    WORD,
    enclave=PATH | st.just("/"),
)
ENDPOINTS = st.builds(
    Entity,
    st.sampled_from([kind for kind in Kind if kind != Kind.NODE]),
    st.integers(0, 232),
    st.text("0123456789abcdef", min_size=1, max_size=32),
    st.integers(0, 99),
    st.integers(0, 9999),
    PATH | st.just("/"),
    WORD,
    PATH,
    TYPE,
    st.sampled_from([HASH, "TypeHashNotSupported"]),
    QOS.map(qos_text),
    PATH | st.just("/"),
)


def test_a_data_key_has_domain_topic_type_and_hash() -> None:
    assert DataKey(0, "/robot/points", "sensor_msgs/msg/PointCloud2", HASH).text == POINTS


def test_the_key_of_a_bridge_is_the_topic_without_its_first_slash() -> None:
    assert bridge_key("/robot/points") == "robot/points"


@given(TYPE)
@examples(50)
def test_a_dds_name_goes_back_to_the_ros_type(ros_type: str) -> None:
    assert ros_name(dds_name(ros_type)) == ros_type


@pytest.mark.parametrize("text", ["PointCloud2", "a/b/C", "a/msg/B/C", "a/msg/*", "", "ä/msg/B"])
def test_a_bad_type_is_an_error(text: str) -> None:
    with pytest.raises(ValueError, match="expected a ROS type"):
        dds_name(text)


@pytest.mark.parametrize("text", ["points", "/", "", "/a//b", "/a/**", "/1", "/a\n"])
def test_a_name_that_is_not_absolute_is_an_error(text: str) -> None:
    with pytest.raises(ValueError, match="expected an absolute ROS name"):
        check_name(text)


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (SENSOR_DATA, "2::,5:,:,:,,"),
        (Qos(transient_local=True, depth=1), ":1:,1:,:,:,,"),
        (Qos(), "::,10:,:,:,,"),
        (Qos(depth=42), "::,:,:,:,,"),
        (Qos(reliable=False, transient_local=True, depth=0), "2:1:2,0:,:,:,,"),
    ],
)
def test_qos_leaves_defaults_out(qos: Qos, text: str) -> None:
    assert qos_text(qos) == text
    assert parse_qos(text) == qos


def test_qos_with_a_lifespan_is_read() -> None:
    assert parse_qos(":1:,1000:,:10,0:,,") == Qos(transient_local=True, depth=1000)


@pytest.mark.parametrize("text", ["", ":", "::", "x::,1:", "::,1x:", "::,-1", "22::,1", "::,²"])
def test_what_is_no_qos_is_none(text: str) -> None:
    assert parse_qos(text) is None


def test_a_bridge_counts_qos_as_dds() -> None:
    assert bridge_qos_text(Qos(reliable=True, transient_local=True, depth=1)) == ":1:1:0,1"
    assert bridge_qos_text(SENSOR_DATA) == ":0:0:0,5"


def test_a_node_has_a_token_with_its_own_id_twice() -> None:
    node = Entity(Kind.NODE, 0, "fe046e", 0, 0, "/", "talker")
    assert node.token == "@ros2_lv/0/fe046e/0/0/NN/%/%/talker"
    assert parse_token(node.token) == node


def test_an_endpoint_has_its_node_topic_type_hash_and_qos_in_its_token() -> None:
    node = "@ros2_lv/7/fe046e/0/10/MS/%/%fleet%a/talker"
    text = f"{node}/%robot%points/sensor_msgs::msg::dds_::PointCloud2_/{HASH}/2::,5:,:,:,,"
    entity = parse_token(text)
    assert entity is not None
    assert (entity.kind, entity.domain, entity.node) == (Kind.SUBSCRIBER, 7, "/fleet/a/talker")
    assert (entity.topic, entity.ros_type) == ("/robot/points", "sensor_msgs/msg/PointCloud2")
    assert (entity.type_hash, entity.qos) == (HASH, SENSOR_DATA)
    assert entity.token == text


@given(NODES | ENDPOINTS)
@examples(200)
def test_a_token_goes_back_to_what_it_was_made_of(entity: Entity) -> None:
    assert parse_token(entity.token) == entity
    zenoh.KeyExpr(entity.token)  # raises for what is no key
    assert len(entity.gid) == 16


@given(ENDPOINTS, st.text("/:, abc%", max_size=30))
@examples(100)
def test_a_token_of_a_newer_version_with_more_at_its_end_is_read(entity: Entity, more: str) -> None:
    assert parse_token(f"{entity.token}/{more}") == entity


@given(st.text(max_size=100) | st.text("@ros2_lv/0MPN%:,", max_size=80).map(lambda text: "@ros2_lv/0/a/0/" + text))
@examples(300)
def test_any_text_is_a_token_or_none(text: str) -> None:
    entity = parse_token(text)
    assert entity is None or isinstance(entity, Entity)


def test_a_token_of_endless_length_is_none() -> None:
    assert parse_token("@ros2_lv/0/a/0/0/NN/%/%/" + "x" * 5000) is None


def test_a_bridge_learns_of_a_service_and_a_publisher_by_their_tokens() -> None:
    service = bridge_token(Kind.SERVICE, "f2f0", "/add_two_ints", "example_interfaces/srv/AddTwoInts", Qos())
    assert service == "@/f2f0/@ros2_lv/SS/add_two_ints/example_interfaces§srv§AddTwoInts"
    publisher = bridge_token(Kind.PUBLISHER, "f2f0", "/a/map", "nav_msgs/msg/OccupancyGrid", Qos(True, True, 1))
    assert publisher == "@/f2f0/@ros2_lv/MP/a§map/nav_msgs§msg§OccupancyGrid/:1:1:0,1"


def test_an_attachment_has_33_bytes() -> None:
    gid = bytes(range(16))
    data = pack_attachment(Attachment(3, -2, gid))
    assert data == b"\x03" + bytes(7) + b"\xfe" + b"\xff" * 7 + b"\x10" + gid
    assert unpack_attachment(data) == Attachment(3, -2, gid)


def test_an_attachment_of_older_versions_is_refused_by_name() -> None:
    old = (
        b"\x0fsequence_number" + struct.pack("<q", 1) + b"\x10source_timestamp" + struct.pack("<q", 2)
        + b"\x0asource_gid\x10" + bytes(16)
    )  # fmt: skip
    with pytest.raises(BadAttachment, match=r"rmw_zenoh before 0.1.2 \(Humble\), 0.2.4 \(Jazzy\)"):
        unpack_attachment(old)


@given(st.binary(max_size=80))
@examples(200)
def test_any_bytes_are_an_attachment_or_refused(data: bytes) -> None:
    try:
        attachment = unpack_attachment(data)
    except BadAttachment:
        return
    assert pack_attachment(attachment) == data
