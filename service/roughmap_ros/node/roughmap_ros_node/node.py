"""A node between ROS 2 and roughmap: messages cross as the bytes that ROS serialised, and none is read here.

The Zenoh key of a topic or service is its name without the first slash, the payload its CDR: the keys of
zenoh-bridge-ros2dds, `keys = "ros2dds"` in roughmap.toml. Needs rclpy and eclipse-zenoh, and Python 3.10 or newer.

A slow link or a slow service must not hold back the drivers. So each message goes into a bounded queue, and a thread
puts it on Zenoh, which may wait (`CongestionControl.BLOCK`; otherwise Zenoh drops messages and tells nobody). A full
queue loses its oldest message, and the node's log says how many. Poses have a queue and a higher Zenoh priority of
their own: clouds don't delay them.
"""

import importlib
import json
import threading
from collections import Counter, deque
from contextlib import suppress
from functools import partial

import rclpy
import zenoh
import zenoh.ext
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message

NONE = [""]
"""A list of no topics: ROS has no empty lists of strings."""

TOPICS_IN = {
    "clouds": (NONE, "sensor_msgs/msg/PointCloud2"),
    "livox": (NONE, "livox_ros_driver2/msg/CustomMsg"),
    "odometry": (NONE, "nav_msgs/msg/Odometry"),
    "pose": (NONE, "geometry_msgs/msg/PoseWithCovarianceStamped"),
    "pose_stamped": (NONE, "geometry_msgs/msg/PoseStamped"),
    "tf": (["/tf", "/tf_static"], "tf2_msgs/msg/TFMessage"),
}
"""Parameters with topics for roughmap: their defaults and types."""

TOPICS_OUT = {
    "grid_maps": "grid_map_msgs/msg/GridMap",
    "occupancy_grids": "nav_msgs/msg/OccupancyGrid",
    "cells": "sensor_msgs/msg/PointCloud2",
}
"""Parameters with topics from roughmap."""

CLOUDS_QUEUED = 10
POSES_QUEUED = 1000
CLOUD_DEPTH = 5
POSE_DEPTH = 100
"""Depths of ROS subscriptions: 0.5 s of clouds at 10 Hz, 0.5 s of poses at 200 Hz."""

MAX_MESSAGE = 256 << 20
"""Bytes of a message from Zenoh; larger ones are dropped."""

QUERY_S = 5.0
"""How long roughmap may take to answer a service."""

SPIN_S = 0.5
"""How soon a thread without callbacks notices that ROS has shut down."""

MATCH_S = 1.0
TELL_S = 10.0

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""QoS of topics from roughmap: who subscribes later gets the newest message. Fits Nav2 and RViz."""


def split_topic(text, default):
    """Return topic and type of "TOPIC" or "TOPIC:pkg/msg/Type"."""
    topic, _, ros_type = text.strip().partition(":")
    return topic, ros_type or default


def load_type(ros_type):
    """Return the class of "pkg/msg/Type"; raises LookupError if it is not installed."""
    try:
        package, group, name = ros_type.split("/")
        return getattr(importlib.import_module(f"{package}.{group}"), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise LookupError(f"{ros_type} is not installed ({error})") from error


def wanted_qos(found, depth, latched):
    """Return the QoS that matches all publishers found and keeps what they offer.

    Reliable if all are: large clouds come in many fragments, and DDS without repair loses most of them. With no
    publisher yet, best effort, which matches all. ``latched``: whether to ask for old messages then.
    """
    reliable = all(qos.reliability == ReliabilityPolicy.RELIABLE for qos in found) if found else latched
    latched = all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in found) if found else latched
    reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    return QoSProfile(depth=depth, reliability=reliability, durability=durability)


def open_session(endpoint):
    """Open a Zenoh session that connects to ``endpoint`` now or whenever it is there, and again after a loss."""
    silent = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    settings = {
        "mode": "peer",
        "connect": {"endpoints": [endpoint], "exit_on_failure": False},
        "listen": {"endpoints": []},
        "scouting": silent,
        "timestamping": {"enabled": True},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


class Lane(threading.Thread):
    """A bounded queue of (publisher, topic, bytes), and the thread that puts them on Zenoh."""

    def __init__(self, name, size):
        super().__init__(name=name, daemon=True)
        self._waiting = deque()
        self._size = size
        self._changed = threading.Condition()
        self._closed = False
        self._lost = Counter()
        self.start()

    def add(self, publisher, topic, payload):
        """Queue a message; a full queue loses its oldest."""
        with self._changed:
            if len(self._waiting) >= self._size:
                self._lost[self._waiting.popleft()[1]] += 1
            self._waiting.append((publisher, topic, payload))
            self._changed.notify()

    def take_lost(self):
        """Return the counts of lost messages by topic since the last call."""
        with self._changed:
            lost, self._lost = self._lost, Counter()
        return lost

    def close(self):
        """End the thread after the message that it puts now."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self.join(2.0)

    def run(self):
        """Put messages, one after the other."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if self._closed:
                    return
                publisher, topic, payload = self._waiting.popleft()
            try:
                publisher.put(payload)
            except zenoh.ZError:
                with self._changed:
                    self._lost[topic] += 1


class TopicIn:
    """A topic from ROS to Zenoh, whose subscription follows the QoS of the topic's publishers."""

    def __init__(self, node, topic, ros_type, lane, priority, depth):
        self._node = node
        self._type = load_type(ros_type)
        self._ros_type = ros_type
        self._lane = lane
        self._depth = depth
        self._qos = self._subscription = None
        self._silent_s = 0.0
        self.echoes = deque(maxlen=16)
        """What the node itself has published on this topic and ROS will bring back to it."""
        self.topic = node.resolve_topic_name(topic)
        self._latched = self.topic.endswith("/tf_static")
        options = {"congestion_control": zenoh.CongestionControl.BLOCK, "priority": priority}
        if self._latched:  # a service that starts later gets the static transforms, too
            options |= {"cache": zenoh.ext.CacheConfig(depth), "publisher_detection": True}
        declare = zenoh.ext.declare_advanced_publisher if self._latched else zenoh.Session.declare_publisher
        self._publisher = declare(node.session, self.topic[1:], **options)
        self.match()

    def match(self):
        """Subscribe as the publishers want it, again if that has changed; say once that there are none."""
        found = self._node.get_publishers_info_by_topic(self.topic)
        others = [info for info in found if info.node_name != self._node.get_name()]
        fitting = [info.qos_profile for info in others if info.topic_type == self._ros_type]
        self._tell_silence(others, fitting)
        qos = wanted_qos(fitting, self._depth, self._latched)
        asked = (qos.reliability, qos.durability)
        if self._subscription is not None and (asked == self._qos or not fitting):
            return
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._qos = asked
        self._subscription = self._node.create_subscription(self._type, self.topic, self._take, qos, raw=True)

    def _tell_silence(self, others, fitting):
        before = self._silent_s
        self._silent_s = 0.0 if fitting else before + MATCH_S
        if before < TELL_S <= self._silent_s:
            types = ", ".join(sorted({info.topic_type for info in others}))
            instead = f"it is published as {types}" if types else "nobody publishes it"
            self._node.get_logger().warning(f"{self.topic}: expected {self._ros_type}; {instead}")

    def _take(self, payload):
        if payload not in self.echoes:
            self._lane.add(self._publisher, self.topic, payload)


class RoughmapNode(Node):
    """The node. Its parameters are in the README; `start` adds the topics, `close` ends everything."""

    def __init__(self, **options):
        super().__init__("roughmap", **options)
        self.endpoint = self.declare_parameter("endpoint", "tcp/127.0.0.1:7447").value
        self.session = open_session(self.endpoint)
        self._clouds = Lane("clouds", CLOUDS_QUEUED)
        self._poses = Lane("poses", POSES_QUEUED)
        self._in = {}
        self._from_zenoh = []
        self._services_node = self._services_thread = None

    def start(self):
        """Add what the parameters name. Types that are not installed are told and left out."""
        for parameter, (default, ros_type) in TOPICS_IN.items():
            for text in self._topics(parameter, default):
                self._try(self._add_in, *split_topic(text, ros_type), parameter in {"clouds", "livox"})
        for parameter, ros_type in TOPICS_OUT.items():
            for text in self._topics(parameter, NONE):
                topic, own_type = split_topic(text, ros_type)
                self._try(self._add_out, topic, own_type)
                if parameter == "occupancy_grids":
                    self._try(self._add_out, f"{topic}_updates", "map_msgs/msg/OccupancyGridUpdate")
                    self._try(self._add_service, f"{topic}/get_map", "nav_msgs/srv/GetMap")
        if self.get_parameter("cells").value != NONE:
            self._try(self._add_out, "/tf_static", "tf2_msgs/msg/TFMessage")  # the cells' local frame
        self.create_timer(MATCH_S, self._match)
        self.create_timer(TELL_S, self._tell)
        self.get_logger().info(f"connects to roughmap at {self.endpoint}")

    def close(self):
        """End threads, the Zenoh session, ROS and the nodes."""
        self._clouds.close()
        self._poses.close()
        self.session.close()
        rclpy.try_shutdown()
        if self._services_node is not None:
            self._services_thread.join(2 * QUERY_S)
            self._services_node.destroy_node()
        self.destroy_node()

    def _topics(self, parameter, default):
        return [text for text in self.declare_parameter(parameter, default).value if text.strip()]

    def _try(self, add, topic, *arguments):
        try:
            add(topic, *arguments)
        except (LookupError, RuntimeError, ValueError, TypeError, zenoh.ZError) as error:
            self.get_logger().error(f"{topic}: left out: {error}")

    def _add_in(self, topic, ros_type, is_cloud):
        lane, depth = (self._clouds, CLOUD_DEPTH) if is_cloud else (self._poses, POSE_DEPTH)
        priority = zenoh.Priority.DATA if is_cloud else zenoh.Priority.INTERACTIVE_HIGH
        added = TopicIn(self, topic, ros_type, lane, priority, depth)
        self._in[added.topic] = added

    def _add_out(self, topic, ros_type):
        publisher = self.create_publisher(load_type(ros_type), topic, LATCHED)
        subscriber = zenoh.ext.declare_advanced_subscriber(
            self.session,
            publisher.topic_name[1:],
            partial(self._publish, publisher, publisher.topic_name),
            allowed_origin=zenoh.Locality.REMOTE,  # not what this node puts on the same key
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
        )
        self._from_zenoh.append(subscriber)

    def _publish(self, publisher, topic, sample):
        size = len(sample.payload)
        payload = sample.payload.to_bytes() if size <= MAX_MESSAGE else b""
        if payload[:2] not in {b"\0\0", b"\0\1"}:  # CDR, big-endian or little-endian
            self.get_logger().warning(f"{topic}: dropped {size} bytes that are no ROS message")
            return
        if topic in self._in:
            self._in[topic].echoes.append(payload)
        try:
            publisher.publish(payload)
        except RuntimeError as error:  # ROS is shutting down, or the middleware refuses
            self.get_logger().warning(f"{topic}: not published: {error}")

    def _add_service(self, name, ros_type):
        """Offer a service in a node and a thread of its own: waiting for the answer must not hold up the topics."""
        kind = load_type(ros_type)
        if self._services_node is None:
            self._services_node = rclpy.create_node(f"{self.get_name()}_services", namespace=self.get_namespace())
            self._services_thread = threading.Thread(target=spin, args=(self._services_node,), daemon=True)
            self._services_thread.start()
        name = self._services_node.resolve_service_name(name)
        self._services_node.create_service(kind, name, partial(self._ask, kind, name))

    def _ask(self, kind, name, request, response):
        """Hand a request to roughmap. Without an answer the reply is empty, and the log says why."""
        why = 'no answer: is roughmap running, with keys = "ros2dds" and this topic?'
        try:
            for reply in self.session.get(name[1:], payload=serialize_message(request), timeout=QUERY_S):
                if reply.ok is not None:
                    return deserialize_message(reply.ok.payload.to_bytes(), kind.Response)
                why = reply.err.payload.to_bytes().decode(errors="replace")
        except (RuntimeError, TypeError, zenoh.ZError) as error:
            why = str(error)
        self.get_logger().warning(f"{name}: replied empty: {why}")
        return response

    def _match(self):
        for topic in self._in.values():
            topic.match()

    def _tell(self):
        for topic, count in sorted((self._clouds.take_lost() + self._poses.take_lost()).items()):
            self.get_logger().warning(f"{topic}: lost {count} messages: Zenoh takes them more slowly than they come")


def spin(node):
    """Run a node's callbacks until ROS shuts down."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        while rclpy.ok():
            try:
                executor.spin_once(timeout_sec=SPIN_S)
            except RuntimeError:
                if rclpy.ok():  # otherwise ROS has shut down since it was asked
                    raise


def main():
    """Run the node until Ctrl-C."""
    rclpy.init()
    node = RoughmapNode()
    try:
        with suppress(KeyboardInterrupt):
            node.start()
            spin(node)
    finally:
        node.close()


if __name__ == "__main__":
    main()
