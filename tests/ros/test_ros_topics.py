"""What crosses between a real ROS 2 graph with Fast DDS and Zenoh, through roughmap's node as colcon built it."""

import base64
import struct
from pathlib import Path
from typing import Any

import pytest
import zenoh
import zenoh.ext
from message_packages import DEFINITIONS
from net import Gathered, wait_until
from ros_processes import Peer, Ros, peer, roughmap_node
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

TYPES = get_typestore(Stores.ROS2_KILTED)
TYPES.register(
    {
        name: fields
        for package, messages in DEFINITIONS.items()
        for message, text in messages.items()
        for name, fields in get_types_from_msg(text, f"{package}/msg/{message}").items()
        if name not in TYPES.fielddefs
    }
)
CLOUD = "sensor_msgs/msg/PointCloud2"
ODOMETRY = "nav_msgs/msg/Odometry"
GRID = "nav_msgs/msg/OccupancyGrid"
Listener = tuple[zenoh.Session, str]


def cloud(points: int = 4, frame: str = "lidar") -> dict[str, Any]:
    data = struct.pack(f"<{3 * points}f", *(0.25 * number for number in range(3 * points)))
    fields = [{"name": name, "offset": 4 * place, "datatype": 7, "count": 1} for place, name in enumerate("xyz")]
    return {
        "header": {"stamp": {"sec": 12, "nanosec": 5}, "frame_id": frame}, "height": 1, "width": points,
        "fields": fields, "point_step": 12, "row_step": 12 * points, "is_dense": True,
        "data": {"base64": base64.b64encode(data).decode()},
    }  # fmt: skip


def check_same(came: bytes, sent: bytes, ros_type: str) -> None:
    """Require the same message, and the same bytes up to the last 3: Fast DDS pads messages to a multiple of 4.

    The message is read by rosbags, and written again with zeros as padding.
    """
    end = len(sent) - 3
    assert end <= len(came) - 3 <= end + 3
    assert came[:end] == sent[:end]
    assert canonical(came, ros_type) == canonical(sent, ros_type)


def canonical(cdr: bytes, ros_type: str) -> bytes:
    return bytes(TYPES.serialize_cdr(TYPES.deserialize_cdr(cdr, ros_type), ros_type))


def check_robot(robot: Peer, session: zenoh.Session, node: Any, space: str) -> Path:
    """Publish a cloud and 20 poses with real ROS; require them on Zenoh. Return the node's log."""
    points, poses = f"{space}/points", f"{space}/odom"
    clouds, odometry = heard(session, points[1:]), heard(session, poses[1:])
    robot.ask("advertise", topic=points, type=CLOUD, depth=5)
    robot.ask("advertise", topic=poses, type=ODOMETRY, depth=100)
    with node(clouds=[points], odometry=[poses]) as log:
        robot.ask("matched", topic=points, reliable=True)
        robot.ask("matched", topic=poses, reliable=True)
        sent = robot.publish(points, **cloud())
        (came,) = clouds.wait(lambda came: len(came) == 1, "a cloud")
        check_same(came, sent, CLOUD)
        posed = [
            robot.publish(poses, header={"frame_id": "odom", "stamp": {"sec": second}}, child_frame_id="base_link")
            for second in range(20)
        ]
        assert odometry.wait(lambda came: len(came) == 20, "20 poses") == posed
    return Path(log)


def heard(session: zenoh.Session, key: str) -> Gathered[bytes]:
    gathered: Gathered[bytes] = Gathered()
    session.declare_subscriber(key, lambda sample: gathered(sample.payload.to_bytes()))
    return gathered


def test_clouds_and_odometry_reach_zenoh_as_the_bytes_that_rclpy_made(
    ros: Ros, robot: Peer, listener: Listener, tmp_path: Path
) -> None:
    session, endpoint = listener
    check_robot(robot, session, lambda **topics: roughmap_node(ros, tmp_path, endpoint, **topics), "/front")


def test_clouds_of_a_best_effort_driver_reach_zenoh(ros: Ros, robot: Peer, listener: Listener, tmp_path: Path) -> None:
    session, endpoint = listener
    clouds = heard(session, "driver/points")
    robot.ask("advertise", topic="/driver/points", type=CLOUD, reliable=False, depth=5)
    with roughmap_node(ros, tmp_path, endpoint, clouds=["/driver/points"]):
        robot.ask("matched", topic="/driver/points", reliable=False)
        sent = []  # the first ones may be lost, as with best effort they may
        wait_until(lambda: sent.append(robot.publish("/driver/points", **cloud())) or clouds.items, "a cloud")
    check_same(clouds.items[0], sent[0], CLOUD)


def test_the_node_runs_with_other_pythons(other_ros: Ros, listener: Listener, tmp_path: Path) -> None:
    (session, endpoint), ros = listener, other_ros
    with peer(ros, tmp_path) as robot:
        log = check_robot(robot, session, lambda **topics: roughmap_node(ros, tmp_path, endpoint, **topics), "/other")
    assert "/tf: left out: tf2_msgs/msg/TFMessage is not installed" in log.read_text()


def test_a_large_cloud_of_a_reliable_driver_arrives_whole(
    ros: Ros, robot: Peer, listener: Listener, tmp_path: Path
) -> None:
    session, endpoint = listener
    clouds = heard(session, "large")
    robot.ask("advertise", topic="/large", type=CLOUD, reliable=True, depth=5)
    with roughmap_node(ros, tmp_path, endpoint, clouds=["/large"]):
        robot.ask("matched", topic="/large", reliable=True)
        sent = robot.publish("/large", **cloud(points=131_072))
        (came,) = clouds.wait(lambda came: len(came) == 1, "a large cloud")
        check_same(came, sent, CLOUD)


def test_static_transforms_reach_a_service_that_starts_later(
    ros: Ros, robot: Peer, listener: Listener, tmp_path: Path
) -> None:
    session, endpoint = listener
    robot.ask("advertise", topic="/tf_static", type="tf2_msgs/msg/TFMessage", latched=True, depth=1)
    transform = {"header": {"frame_id": "base_link"}, "child_frame_id": "lidar"}
    sent = robot.publish("/tf_static", transforms=[transform])
    with roughmap_node(ros, tmp_path, endpoint):
        robot.ask("matched", topic="/tf_static", reliable=True)
        gathered: Gathered[bytes] = Gathered()
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=100)
        subscriber = zenoh.ext.declare_advanced_subscriber(
            session, "tf_static", lambda sample: gathered(sample.payload.to_bytes()), history=history
        )
        assert gathered.wait(lambda came: len(came) > 0, "static transforms")[0] == sent
        subscriber.undeclare()


def test_livox_clouds_and_transforms_reach_zenoh(ros: Ros, robot: Peer, listener: Listener, tmp_path: Path) -> None:
    session, endpoint = listener
    livox, moving = heard(session, "livox/lidar"), heard(session, "tf")
    robot.ask("advertise", topic="/livox/lidar", type="livox_ros_driver2/msg/CustomMsg")
    robot.ask("advertise", topic="/tf", type="tf2_msgs/msg/TFMessage", depth=100)
    with roughmap_node(ros, tmp_path, endpoint, livox=["/livox/lidar"]):
        for topic in ("/livox/lidar", "/tf"):
            robot.ask("matched", topic=topic, reliable=True)
        sent = robot.publish("/livox/lidar", timebase=7, point_num=1, points=[{"x": 1.0, "offset_time": 9, "line": 3}])
        (came,) = livox.wait(lambda came: len(came) == 1, "a Livox cloud")
        check_same(came, sent, "livox_ros_driver2/msg/CustomMsg")
        moved = robot.publish("/tf", transforms=[{"header": {"frame_id": "map"}, "child_frame_id": "odom"}])
        assert moving.wait(lambda came: len(came) == 1, "a transform") == [moved]


def test_a_late_subscriber_gets_the_occupancy_grid(ros: Ros, robot: Peer, listener: Listener, tmp_path: Path) -> None:
    session, endpoint = listener
    sent = robot.serialise(
        GRID, header={"frame_id": "map"}, info={"resolution": 0.25, "width": 2, "height": 2}, data=[0, 100, -1, 50]
    )
    cache = zenoh.ext.CacheConfig(1)
    publisher = zenoh.ext.declare_advanced_publisher(session, "costmap", cache=cache, publisher_detection=True)
    publisher.put(sent)  # before there is a node
    with roughmap_node(ros, tmp_path, endpoint, occupancy_grids=["/costmap"]):
        robot.ask("subscribe", topic="/costmap", type=GRID, latched=True, depth=1)
        (came, *_), text = robot.received("/costmap", GRID)
    check_same(came, sent, GRID)
    assert "data=[0, 100, -1, 50]" in text


@pytest.mark.parametrize(
    ("parameter", "topic", "suffix", "ros_type", "message"),
    [
        ("grid_maps", "/grid", "", "grid_map_msgs/msg/GridMap",
         {"layers": ["mean_height"], "info": {"resolution": 0.5}, "data": [{"data": [1.0, 2.0]}]}),
        ("cells", "/cells", "", CLOUD, cloud(frame="map_local")),
        ("occupancy_grids", "/cost", "_updates", "map_msgs/msg/OccupancyGridUpdate",
         {"x": 3, "width": 2, "height": 1, "data": [0, 100]}),
    ],
)  # fmt: skip
def test_maps_reach_ros_as_the_bytes_that_were_put(
    ros: Ros, robot: Peer, listener: Listener, tmp_path: Path,
    parameter: str, topic: str, suffix: str, ros_type: str, message: dict[str, Any],
) -> None:  # fmt: skip
    session, endpoint = listener
    sent = robot.serialise(ros_type, **message)
    robot.ask("subscribe", topic=topic + suffix, type=ros_type, latched=True, depth=1)
    cache = zenoh.ext.CacheConfig(1)
    key = (topic + suffix)[1:]
    publisher = zenoh.ext.declare_advanced_publisher(session, key, cache=cache, publisher_detection=True)
    with roughmap_node(ros, tmp_path, endpoint, **{parameter: [topic]}):
        publisher.put(sent)
        check_same(robot.received(topic + suffix, ros_type)[0][0], sent, ros_type)


def test_the_frame_of_cells_goes_out_on_tf_static_and_does_not_come_back(
    ros: Ros, robot: Peer, listener: Listener, tmp_path: Path
) -> None:
    session, endpoint = listener
    kind = "tf2_msgs/msg/TFMessage"
    ours = robot.serialise(kind, transforms=[{"header": {"frame_id": "map"}, "child_frame_id": "map_local"}])
    back = heard(session, "tf_static")
    robot.ask("subscribe", topic="/tf_static", type=kind, latched=True, depth=100)
    cache = zenoh.ext.CacheConfig(1)
    publisher = zenoh.ext.declare_advanced_publisher(session, "tf_static", cache=cache, publisher_detection=True)
    with roughmap_node(ros, tmp_path, endpoint, cells=["/cells_tf"]):
        publisher.put(ours)
        wait_until(lambda: ours in robot.received("/tf_static", kind)[0], "the frame of the cells")
        robot.ask("advertise", topic="/tf_static", type=kind, latched=True, depth=1)
        theirs = robot.publish("/tf_static", transforms=[{"child_frame_id": "camera"}])
        assert theirs in back.wait(lambda came: theirs in came, "the robot's transform")
    assert back.items.count(ours) == 1  # what the publisher itself has put


def test_get_map_of_a_real_client_is_answered(ros: Ros, robot: Peer, listener: Listener, tmp_path: Path) -> None:
    session, endpoint = listener
    grid = {"header": {"frame_id": "map"}, "info": {"width": 2, "height": 1}, "data": [100, -1]}
    reply = robot.serialise("nav_msgs/srv/GetMap_Response", map=grid)
    requests: Gathered[bytes] = Gathered()

    def answer(query: zenoh.Query) -> None:
        requests(b"" if query.payload is None else query.payload.to_bytes())
        query.reply("plan/get_map", reply)

    queryable = session.declare_queryable("plan/get_map", answer)
    with roughmap_node(ros, tmp_path, endpoint, occupancy_grids=["/plan"]):
        came = robot.ask("call", service="/plan/get_map", type="nav_msgs/srv/GetMap")
    queryable.undeclare()
    assert canonical(base64.b64decode(came["cdr"]), GRID) == canonical(reply, GRID)  # the reply has no other field
    assert requests.items[0][:4] == b"\0\1\0\0"


def test_without_a_service_get_map_is_an_empty_map_and_the_log_says_why(
    ros: Ros, robot: Peer, listener: Listener, tmp_path: Path
) -> None:
    with roughmap_node(ros, tmp_path, listener[1], occupancy_grids=["/lonely"]) as log:
        came = robot.ask("call", service="/lonely/get_map", type="nav_msgs/srv/GetMap")
        wait_until(lambda: "/lonely/get_map: replied empty: no answer" in log.read_text(), "the reason")
    assert "width=0, height=0" in came["text"]


def test_the_graph_of_ros_shows_node_topics_qos_and_service(
    ros: Ros, robot: Peer, listener: Listener, tmp_path: Path
) -> None:
    topics = {"clouds": ["/seen/points"], "odometry": ["/seen/odom"], "occupancy_grids": ["/seen/map"]}
    with roughmap_node(ros, tmp_path, listener[1], **topics):
        services = robot.ask("graph", node="roughmap_services")["services"]
        graph = robot.ask("graph", node="roughmap")
    assert services["/seen/map/get_map"] == ["nav_msgs/srv/GetMap"]
    hears, says = graph["subscribes"], graph["publishes"]
    assert hears["/seen/points"] == {"types": [CLOUD], "qos": [["BEST_EFFORT", "VOLATILE"]]}
    assert hears["/seen/odom"] == {"types": [ODOMETRY], "qos": [["BEST_EFFORT", "VOLATILE"]]}
    assert hears["/tf_static"]["types"] == ["tf2_msgs/msg/TFMessage"]
    assert says["/seen/map"] == {"types": [GRID], "qos": [["RELIABLE", "TRANSIENT_LOCAL"]]}
    assert says["/seen/map_updates"]["qos"] == [["RELIABLE", "TRANSIENT_LOCAL"]]
