"""Nodes on real Zenoh sessions: messages, late joiners, services, and what other nodes see of them."""

import json
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest
import zenoh
from net import WAIT_S, Gathered, open_listener, peer_config, wait_for, wait_until

from roughmap_ros.wire import (
    SENSOR_DATA,
    Kind,
    Qos,
    Received,
    RosNode,
    RosPublisher,
    enable_timestamps,
)
from roughmap_ros.wire.attachment import Attachment, pack_attachment, unpack_attachment
from roughmap_ros.wire.errors import WireError
from roughmap_ros.wire.matching import mismatches
from roughmap_ros.wire.node import endpoints_seen
from roughmap_ros.wire.services import MAX_REQUEST, MAX_WAITING
from roughmap_schemas.faults import ReportedError

CLOUD, HASH = "sensor_msgs/msg/PointCloud2", "RIHS01_9198"
GRID, GRID_HASH = "nav_msgs/msg/OccupancyGrid", "RIHS01_8d34"
GET_MAP, GET_MAP_HASH = "nav_msgs/srv/GetMap", "RIHS01_c8ae"
LATCHED = Qos(transient_local=True, depth=1)
GET_MAP_KEY = "0/roughmap/get_map/nav_msgs::srv::dds_::GetMap_/RIHS01_c8ae"
CDR = bytes([0, 1, 0, 0])


def client_config(endpoints: list[str]) -> zenoh.Config:
    config = peer_config(connect=endpoints, mode="client")
    enable_timestamps(config)
    return config


@contextmanager
def open_router() -> Iterator[list[str]]:
    """A router in this process, as rmw_zenohd is; its endpoints."""
    with zenoh.open(peer_config(listen=True, mode="router")) as router:
        for reply in router.get(f"@/{router.zid()}/router", timeout=WAIT_S):
            if reply.ok is not None:
                yield [str(one) for one in json.loads(reply.ok.payload.to_bytes())["locators"]]
                return
    raise AssertionError("the router's admin space did not answer")


@pytest.fixture
def sessions() -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    """Two clients of a router."""
    with ExitStack() as stack:
        endpoints = stack.enter_context(open_router())
        first, second = (stack.enter_context(zenoh.open(client_config(endpoints))) for _ in range(2))
        yield first, second


@pytest.fixture
def nodes(sessions: tuple[zenoh.Session, zenoh.Session]) -> Iterator[tuple[RosNode, RosNode]]:
    """A driver and a mapper."""
    first, second = sessions
    with (
        RosNode(first, "driver", keys="rmw_zenoh", namespace="/robot") as driver,
        RosNode(second, "mapper", keys="rmw_zenoh", max_message=1000) as mapper,
    ):
        yield driver, mapper


def matching(endpoint: zenoh.Publisher | zenoh.Querier) -> bool:
    return bool(getattr(endpoint.matching_status, "matching", endpoint.matching_status))


def await_match(publisher: RosPublisher) -> None:
    wait_until(lambda: publisher.matched, "a subscriber of the topic")


def test_a_message_comes_with_its_number_time_and_sender(nodes: tuple[RosNode, RosNode]) -> None:
    driver, mapper = nodes
    came: Gathered[Received] = Gathered()
    mapper.subscriber("/points", CLOUD, HASH, SENSOR_DATA, came)
    publisher = driver.publisher("/points", CLOUD, HASH, SENSOR_DATA)
    await_match(publisher)
    before = time.time_ns()
    publisher.put(CDR + b"one")
    publisher.put(CDR + b"two")
    items = came.wait(lambda items: len(items) == 2, "two messages")
    assert [(item.payload, item.sequence) for item in items] == [(CDR + b"one", 1), (CDR + b"two", 2)]
    (entity,) = wait_until(mapper.seen, "the driver's publisher")
    assert {item.gid for item in items} == {entity.gid}
    assert all(before <= (item.source_ns or 0) <= item.received_ns for item in items)
    assert (mapper.mismatches(), mapper.unpublished(), mapper.refused) == ([], [], {})


def test_peers_without_a_router_hear_each_other_too() -> None:
    with (
        open_listener() as (first, endpoints),
        zenoh.open(peer_config(connect=endpoints)) as second,
        RosNode(first, "mapper", keys="rmw_zenoh", domain=7) as mapper,
        RosNode(second, "driver", keys="rmw_zenoh", domain=7) as driver,
    ):
        came: Gathered[Received] = Gathered()
        mapper.subscriber("/points", CLOUD, HASH, SENSOR_DATA, came)
        publisher = driver.publisher("/points", CLOUD, HASH, SENSOR_DATA)
        await_match(publisher)
        publisher.put(CDR)
        assert came.wait(bool, "the message")[0].payload == CDR


@pytest.mark.parametrize("keys", ["rmw_zenoh", "ros2dds"])
def test_a_late_joiner_gets_the_last_grid_and_those_after_it(
    sessions: tuple[zenoh.Session, zenoh.Session], keys: str
) -> None:
    first, second = sessions
    with RosNode(first, "map", keys=keys) as mapper, RosNode(second, "nav", keys=keys) as planner:  # type: ignore[arg-type]
        publisher = mapper.publisher("/grid", GRID, GRID_HASH, LATCHED)
        passed: Gathered[zenoh.Sample] = Gathered()
        witness = second.declare_subscriber(f"{'0/' if keys == 'rmw_zenoh' else ''}grid/**", passed)
        await_match(publisher)
        for text in (b"first", b"second"):
            publisher.put(CDR + text)
        passed.wait(lambda items: len(items) == 2, "both grids to be under way no more")
        witness.undeclare()
        came: Gathered[Received] = Gathered()
        planner.subscriber("/grid", GRID, GRID_HASH, LATCHED, came)
        came.wait(lambda items: len(items) == 1, "the last grid")
        await_match(publisher)
        publisher.put(CDR + b"third")
        items = came.wait(lambda items: len(items) == 2, "the next grid")
        assert [item.payload for item in items] == [CDR + b"second", CDR + b"third"]
        assert [item.sequence for item in items] == ([2, 3] if keys == "rmw_zenoh" else [None, None])


def test_a_subscriber_gets_the_last_grid_of_a_publisher_that_comes_later(nodes: tuple[RosNode, RosNode]) -> None:
    driver, mapper = nodes
    came: Gathered[Received] = Gathered()
    mapper.subscriber("/grid", GRID, GRID_HASH, LATCHED, came)
    driver.publisher("/grid", GRID, GRID_HASH, LATCHED).put(CDR + b"grid")
    assert came.wait(bool, "the grid")[0].payload == CDR + b"grid"


def test_a_best_effort_latched_publisher_needs_timestamps() -> None:
    config = peer_config(timestamping__enabled=False)
    with (
        zenoh.open(config) as session,
        RosNode(session, "mapper", keys="rmw_zenoh") as mapper,
        pytest.raises(WireError, match=r"^/grid: .* set timestamping.enabled to true"),
    ):
        mapper.publisher("/grid", GRID, GRID_HASH, LATCHED._replace(reliable=False))
    enable_timestamps(config)
    with zenoh.open(config) as session, RosNode(session, "mapper", keys="rmw_zenoh") as mapper:
        mapper.publisher("/grid", GRID, GRID_HASH, LATCHED._replace(reliable=False)).put(CDR)


def call(session: zenoh.Session, key: str, payload: bytes | None, attachment: bytes | None) -> zenoh.Reply:
    """Ask as a ROS client does, and return the one reply."""
    replies = list(
        session.get(key, payload=payload, attachment=attachment, timeout=WAIT_S, target=zenoh.QueryTarget.ALL_COMPLETE)
    )
    assert len(replies) == 1
    return replies[0]


def await_service(session: zenoh.Session, key: str) -> None:
    querier = session.declare_querier(key, target=zenoh.QueryTarget.ALL_COMPLETE)
    wait_until(lambda: matching(querier), "the service")
    querier.undeclare()


def test_a_reply_repeats_number_and_sender_of_its_request(sessions: tuple[zenoh.Session, zenoh.Session]) -> None:
    first, second = sessions
    with RosNode(first, "mapper", keys="rmw_zenoh") as mapper:
        mapper.service("/roughmap/get_map", GET_MAP, GET_MAP_HASH, lambda request: request + b"map")
        await_service(second, GET_MAP_KEY)
        asked = Attachment(9, 123, bytes(range(16)))
        before = time.time_ns()
        reply = call(second, GET_MAP_KEY, CDR + b"\0", pack_attachment(asked)).ok
        assert reply is not None
        assert reply.payload.to_bytes() == CDR + b"\0map"
        assert reply.attachment is not None
        echoed = unpack_attachment(reply.attachment.to_bytes())
        assert (echoed.sequence, echoed.gid) == (9, asked.gid)
        assert echoed.source_ns >= before


def test_requests_that_cannot_be_answered_get_an_error(sessions: tuple[zenoh.Session, zenoh.Session]) -> None:
    class NoMap(ReportedError):
        pass

    def answer(request: bytes) -> bytes:
        if request == CDR:
            raise NoMap("no map yet")
        raise ZeroDivisionError

    first, second = sessions
    good = pack_attachment(Attachment(1, 2, bytes(16)))
    with RosNode(first, "mapper", keys="rmw_zenoh") as mapper:
        mapper.service("/roughmap/get_map", GET_MAP, GET_MAP_HASH, answer)
        await_service(second, GET_MAP_KEY)
        for payload, attachment, words in (
            (CDR, good, "no map yet"),
            (CDR + b"x", good, "an internal error; see the log lines"),
            (CDR, None, "expected an attachment of rmw_zenoh; found none"),
            (CDR, bytes(2000), "expected an attachment of rmw_zenoh; found more than 1024 bytes"),
            (None, good, "expected a request in CDR; found none"),
            (bytes(MAX_REQUEST + 1), good, "expected a request of at most 65536 bytes; found 65537"),
        ):
            error = call(second, GET_MAP_KEY, payload, attachment).err
            assert error is not None
            assert error.payload.to_string().startswith(words)
        assert sum(mapper.refused.values()) == 6
        assert {topic for topic, _ in mapper.refused} == {"/roughmap/get_map"}


def test_requests_beyond_those_that_wait_are_refused(sessions: tuple[zenoh.Session, zenoh.Session]) -> None:
    first, second = sessions
    begun, go_on = threading.Event(), threading.Event()

    def answer(request: bytes) -> bytes:
        begun.set()
        wait_for(go_on, "the test")
        return request

    replies: Gathered[zenoh.Reply] = Gathered()
    attachment = pack_attachment(Attachment(1, 2, bytes(16)))
    with RosNode(first, "mapper", keys="rmw_zenoh") as mapper:
        mapper.service("/roughmap/get_map", GET_MAP, GET_MAP_HASH, answer)
        await_service(second, GET_MAP_KEY)

        def ask() -> None:
            second.get(GET_MAP_KEY, replies, payload=CDR, attachment=attachment, timeout=WAIT_S)

        ask()
        wait_for(begun, "the first request")
        for _ in range(MAX_WAITING + 2):
            ask()
        refused = replies.wait(lambda items: len(items) == 2, "two refusals")
        assert all(reply.err is not None for reply in refused)
        go_on.set()
        everything = replies.wait(lambda items: len(items) == MAX_WAITING + 3, "all replies")
        assert sum(reply.ok is not None for reply in everything) == MAX_WAITING + 1


def test_what_is_no_message_of_a_ros_node_is_refused_by_name(
    sessions: tuple[zenoh.Session, zenoh.Session], nodes: tuple[RosNode, RosNode]
) -> None:
    driver, mapper = nodes
    came: Gathered[Received] = Gathered()
    mapper.subscriber("/points", CLOUD, HASH, SENSOR_DATA, came)
    await_match(driver.publisher("/points", CLOUD, HASH, SENSOR_DATA))
    good = pack_attachment(Attachment(1, 2, bytes(16)))
    old = b"\x0fsequence_number" + struct.pack("<q", 1) + bytes(54)
    base = "0/points/sensor_msgs::msg::dds_::PointCloud2_"
    first = sessions[0]
    for hashed, payload, attachment in (
        (HASH, CDR, None),
        (HASH, CDR, old),
        (HASH, CDR, bytes(33)),
        (HASH, bytes(1001), good),
        ("RIHS01_other", CDR, good),
        ("TypeHashNotSupported", CDR, good),
    ):
        first.put(f"{base}/{hashed}", payload, attachment=attachment)
    first.delete(f"{base}/{HASH}")
    first.put(f"{base}/{HASH}", CDR + b"good", attachment=good)
    assert came.wait(bool, "the good message")[0].payload == CDR + b"good"
    assert len(came.items) == 1
    reasons = sorted(reason for (topic, reason), number in mapper.refused.items() if (topic, number) == ("/points", 1))
    expected = [
        "an attachment with names of fields, as of rmw_zenoh before",
        "expected a gid of 16 bytes",
        "expected a put; found a delete",
        "expected an attachment of rmw_zenoh; found none",
        "hash RIHS01_other differs: another version of sensor_msgs/msg/PointCloud2",
        "larger than 1000 bytes (input.max_message)",
        "type hash TypeHashNotSupported: rmw_zenoh of ROS 2 Humble",
    ]
    assert len(reasons) == len(expected)
    for reason, beginning in zip(reasons, expected, strict=True):
        assert reason.startswith(beginning)


def test_a_callback_that_fails_is_counted_and_the_next_message_comes(nodes: tuple[RosNode, RosNode]) -> None:
    class Bad(ReportedError):
        pass

    driver, mapper = nodes
    came: Gathered[bytes] = Gathered()

    def take(received: Received) -> None:
        if received.payload == b"bad":
            raise Bad("the cloud has no x")
        if received.payload == b"worse":
            raise ZeroDivisionError
        came(received.payload)

    mapper.subscriber("/points", CLOUD, HASH, SENSOR_DATA, take)
    publisher = driver.publisher("/points", CLOUD, HASH, SENSOR_DATA)
    await_match(publisher)
    for payload in (b"bad", b"worse", b"good"):
        publisher.put(payload)
    assert came.wait(bool, "the good message") == [b"good"]
    assert mapper.refused == {
        ("/points", "the cloud has no x"): 1,
        ("/points", "an internal error; see the log lines"): 1,
    }


def test_endpoints_that_do_not_fit_are_told(nodes: tuple[RosNode, RosNode]) -> None:
    driver, mapper = nodes
    for topic in ("/a", "/b", "/c", "/d", "/e"):
        mapper.subscriber(topic, CLOUD, HASH, Qos(), lambda received: None)
    driver.publisher("/a", CLOUD, HASH, SENSOR_DATA)
    driver.publisher("/b", "sensor_msgs/msg/LaserScan", HASH, Qos())
    driver.publisher("/c", CLOUD, "RIHS01_other", Qos())
    driver.publisher("/d", CLOUD, "TypeHashNotSupported", Qos())
    wait_until(lambda: len(mapper.seen()) == 4, "the driver's publishers")
    a, b, c, d = mapper.mismatches()
    (e,) = mapper.unpublished()
    assert a == "/a: a publisher (/robot/driver) offers best_effort volatile; we ask for reliable"
    assert b == f"/b: a publisher (/robot/driver) has another type: sensor_msgs/msg/LaserScan; expected {CLOUD}"
    assert c.startswith("/c: a publisher (/robot/driver): hash RIHS01_other differs")
    assert d.startswith("/d: a publisher (/robot/driver) has the type hash TypeHashNotSupported")
    assert e == f"/e: no node publishes it; {CLOUD} is on /a, /c, /d"


def test_one_who_is_no_node_sees_what_does_not_fit(
    sessions: tuple[zenoh.Session, zenoh.Session], nodes: tuple[RosNode, RosNode]
) -> None:
    driver, mapper = nodes
    mapper.subscriber("/points", CLOUD, HASH, Qos(), lambda received: None)
    driver.publisher("/points", CLOUD, HASH, SENSOR_DATA)
    seen = wait_until(lambda: len(all_ := endpoints_seen(sessions[0], 0)) == 2 and all_, "both endpoints")
    assert isinstance(seen, list)
    ours = [entity for entity in seen if entity.node == "/mapper"]
    others = [entity for entity in seen if entity.node != "/mapper"]
    assert mismatches(ours, others) == mapper.mismatches() != []
    assert endpoints_seen(sessions[0], 1) == []


def test_nothing_is_left_of_a_node_that_ended(sessions: tuple[zenoh.Session, zenoh.Session]) -> None:
    first, second = sessions

    def tokens() -> list[str]:
        replies = second.liveliness().get("@ros2_lv/0/**", timeout=WAIT_S)
        return sorted(str(reply.ok.key_expr).split("/")[5] for reply in replies if reply.ok is not None)

    with RosNode(first, "mapper", keys="rmw_zenoh") as mapper:
        publisher = mapper.publisher("/grid", GRID, GRID_HASH, LATCHED)
        mapper.subscriber("/points", CLOUD, HASH, SENSOR_DATA, lambda received: None)
        mapper.service("/roughmap/get_map", GET_MAP, GET_MAP_HASH, lambda request: request)
        wait_until(lambda: tokens() == sorted([Kind.NODE, Kind.PUBLISHER, Kind.SUBSCRIBER, Kind.SERVICE]), "all tokens")
        publisher.put(CDR)
        await_service(second, GET_MAP_KEY)
        points = second.declare_publisher("0/points/sensor_msgs::msg::dds_::PointCloud2_/RIHS01_9198")
        wait_until(lambda: matching(points), "the subscriber")
    wait_until(lambda: not tokens(), "the end of all tokens")
    wait_until(lambda: not matching(points), "the end of the subscriber")
    assert list(second.get(GET_MAP_KEY, payload=CDR, timeout=WAIT_S)) == []
    assert list(second.get("0/grid/**", timeout=WAIT_S)) == []


def test_a_bridge_gets_plain_cdr_on_plain_keys(sessions: tuple[zenoh.Session, zenoh.Session]) -> None:
    first, bridge = sessions
    came: Gathered[Received] = Gathered()
    grids: Gathered[tuple[str, bytes, object]] = Gathered()
    with RosNode(first, "mapper", keys="ros2dds") as mapper:
        mapper.subscriber("/robot/points", CLOUD, HASH, SENSOR_DATA, came)
        mapper.service("/roughmap/get_map", GET_MAP, GET_MAP_HASH, lambda request: request + b"map")
        publisher = mapper.publisher("/roughmap/grid", GRID, GRID_HASH, Qos())
        grid = bridge.declare_subscriber(
            "roughmap/grid", lambda s: grids((str(s.key_expr), s.payload.to_bytes(), s.attachment))
        )
        await_match(publisher)
        publisher.put(CDR + b"grid")
        assert grids.wait(bool, "the grid") == [("roughmap/grid", CDR + b"grid", None)]
        grid.undeclare()
        points = bridge.declare_publisher("robot/points")
        wait_until(lambda: matching(points), "the subscriber")
        points.put(CDR + b"points")
        assert came.wait(bool, "the points")[0][::2] == (CDR + b"points", None, None)
        await_service(bridge, "roughmap/get_map")
        reply = call(bridge, "roughmap/get_map", CDR, b"client and number of the bridge").ok
        assert reply is not None
        assert (reply.payload.to_bytes(), reply.attachment) == (CDR + b"map", None)
        tokens = [reply.ok for reply in bridge.liveliness().get(f"@/{first.zid()}/@ros2_lv/**", timeout=WAIT_S)]
        assert sorted(str(token.key_expr).split("/", 3)[3] for token in tokens if token is not None) == [
            "MP/roughmap§grid/nav_msgs§msg§OccupancyGrid/:1:0:0,10",
            "SS/roughmap§get_map/nav_msgs§srv§GetMap",
        ]
        assert mapper.seen() == []
        assert (mapper.mismatches(), mapper.unpublished(), mapper.refused) == ([], [], {})


@pytest.mark.parametrize("name", ["", "a/b", "1a", "a b", "ä"])
def test_a_bad_name_is_an_error(name: str) -> None:
    with zenoh.open(peer_config()) as session, pytest.raises(ValueError, match="expected a node's name"):
        RosNode(session, name, keys="rmw_zenoh")


def test_a_closed_session_gives_one_line() -> None:
    session = zenoh.open(peer_config())
    node = RosNode(session, "mapper", keys="rmw_zenoh")
    publisher = node.publisher("/points", CLOUD, HASH, SENSOR_DATA)
    session.close()
    with pytest.raises(WireError, match=r"^/points: Zenoh: [^\n]+$"):
        publisher.put(CDR)
    node.close()


def test_all_endpoints_of_many_nodes_are_seen(sessions: tuple[zenoh.Session, zenoh.Session]) -> None:
    """More than a channel of Zenoh's holds, which a robot with Nav2 has; names that a terminal would obey are none."""
    first, second = sessions
    number = 600
    with RosNode(first, "mapper", keys="rmw_zenoh") as mapper:
        head = "@ros2_lv/0/1a/0"
        end = f"%topic/std_msgs::msg::dds_::String_/RIHS01_{'0' * 64}/::,5:,:,:,,"
        tokens = [
            second.liveliness().declare_token(f"{head}/{n}/MP/%/%/{name}/{end}")
            for n, name in ((0, "a\x1b[2J"), *((n, "node") for n in range(1, number + 1)))
        ]
        wait_until(lambda: len(mapper.seen()) >= number, "all endpoints")
        assert {entity.id for entity in mapper.seen()} == set(range(1, number + 1))
        for token in tokens:
            token.undeclare()
