"""A ROS 2 node that does what a test tells it: a JSON command on each line of stdin, a JSON answer on stdout.

Runs in an environment with ROS alone. Bytes are base64. A command that fails answers {"error": ...}.
"""

import base64
import contextlib
import importlib
import json
import sys
import threading
import time
from functools import partial
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message

WAIT_S = 30.0


def load(ros_type: str) -> Any:
    package, group, name = ros_type.split("/")
    return getattr(importlib.import_module(f"{package}.{group}"), name)


def filled(message: Any, fields: dict[str, Any]) -> Any:
    """Set fields of a message by name: {"header": {"frame_id": "lidar"}}, {"transforms": [{...}]}."""
    for name, value in fields.items():
        if isinstance(value, dict):
            if set(value) == {"base64"}:
                setattr(message, name, base64.b64decode(value["base64"]))
            else:
                filled(getattr(message, name), value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            kind = message.get_fields_and_field_types()[name].removeprefix("sequence<").removesuffix(">")
            package, plain = kind.split("/")
            setattr(message, name, [filled(load(f"{package}/msg/{plain}")(), one) for one in value])
        else:
            setattr(message, name, value)
    return message


def qos(command: dict[str, Any]) -> QoSProfile:
    return QoSProfile(
        depth=command.get("depth", 10),
        reliability=ReliabilityPolicy.RELIABLE if command.get("reliable", True) else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if command.get("latched") else DurabilityPolicy.VOLATILE,
    )


class Peer:
    """The node and what it has heard. Waits ask the graph again until it is as wanted."""

    def __init__(self, name: str) -> None:
        self.node: Node = rclpy.create_node(name)
        self.publishers: dict[str, Any] = {}
        self.heard: dict[str, list[bytes]] = {}
        self.changed = threading.Condition()

    def hear(self, topic: str, payload: bytes) -> None:
        with self.changed:
            self.heard[topic].append(payload)
            self.changed.notify_all()

    def until(self, condition: Any, what: str) -> Any:
        with self.changed:
            for _ in range(int(WAIT_S / 0.05)):
                if found := condition():
                    return found
                self.changed.wait(0.05)
        raise TimeoutError(f"waited {WAIT_S:g} s in vain for {what}")

    def advertise(self, command: dict[str, Any]) -> dict[str, Any]:
        """Publish a topic; wait for ``matched`` subscribers."""
        topic = command["topic"]
        publisher = self.node.create_publisher(load(command["type"]), topic, qos(command))
        self.publishers[topic] = publisher
        return {}

    def matched(self, command: dict[str, Any]) -> dict[str, Any]:
        """Wait until the subscribers of a topic are these: {"reliable": true} each."""
        reliable, topic = command["reliable"], command["topic"]

        def there() -> bool:
            found = self.node.get_subscriptions_info_by_topic(topic)
            asked = [info.qos_profile.reliability == ReliabilityPolicy.RELIABLE for info in found]
            return asked == [reliable] and self.publishers[topic].get_subscription_count() == 1

        self.until(there, f"one subscriber of {topic}, reliable: {reliable}")
        return {}

    def publish(self, command: dict[str, Any]) -> dict[str, Any]:
        """Publish a message and return the bytes that rclpy makes of it."""
        publisher = self.publishers[command["topic"]]
        raw = serialize_message(filled(publisher.msg_type(), command["message"]))
        publisher.publish(raw)
        return {"cdr": base64.b64encode(raw).decode()}

    def publish_cdr(self, command: dict[str, Any]) -> dict[str, Any]:
        """Publish serialised messages, each when it is due, in seconds from the first, as a robot would."""
        start = time.monotonic()
        for due, topic, payload in command["messages"]:
            time.sleep(max(start + due - time.monotonic(), 0.0))
            self.publishers[topic].publish(base64.b64decode(payload))
        return {}

    def subscribe(self, command: dict[str, Any]) -> dict[str, Any]:
        topic = command["topic"]
        self.heard[topic] = []
        self.node.create_subscription(load(command["type"]), topic, partial(self.hear, topic), qos(command), raw=True)
        return {}

    def received(self, command: dict[str, Any]) -> dict[str, Any]:
        """Wait until ``count`` messages have come; return their bytes, and the newest as text."""
        topic, count = command["topic"], command["count"]
        self.until(lambda: len(self.heard[topic]) >= count, f"{count} messages of {topic}")
        newest = deserialize_message(self.heard[topic][-1], load(command["type"]))
        return {"cdr": [base64.b64encode(one).decode() for one in self.heard[topic]], "text": str(newest)}

    def call(self, command: dict[str, Any]) -> dict[str, Any]:
        """Call a service and return the reply's bytes."""
        kind = load(command["type"])
        client = self.node.create_client(kind, command["service"])
        self.until(client.service_is_ready, command["service"])
        future = client.call_async(kind.Request())
        self.until(future.done, f"a reply of {command['service']}")
        reply = future.result()
        return {"cdr": base64.b64encode(serialize_message(reply)).decode(), "text": str(reply)}

    def graph(self, command: dict[str, Any]) -> dict[str, Any]:
        """Wait until node ``node`` is there; return what the graph tells of it."""
        name, space = command["node"], "/"
        self.until(lambda: (name, space) in self.node.get_node_names_and_namespaces(), f"the node {name}")

        def endpoints(find: Any, ask: Any) -> dict[str, Any]:
            topics = dict(find(name, space))
            return {
                topic: {
                    "types": types,
                    "qos": [
                        [info.qos_profile.reliability.name, info.qos_profile.durability.name]
                        for info in ask(topic)
                        if info.node_name == name
                    ],
                }
                for topic, types in topics.items()
            }

        return {
            "subscribes": endpoints(
                self.node.get_subscriber_names_and_types_by_node, self.node.get_subscriptions_info_by_topic
            ),
            "publishes": endpoints(
                self.node.get_publisher_names_and_types_by_node, self.node.get_publishers_info_by_topic
            ),
            "services": dict(self.node.get_service_names_and_types_by_node(name, space)),
        }

    def serialise(self, command: dict[str, Any]) -> dict[str, Any]:
        """Return a message's bytes without publishing it."""
        raw = serialize_message(filled(load(command["type"])(), command["message"]))
        return {"cdr": base64.b64encode(raw).decode()}


def main() -> None:
    rclpy.init()
    peer = Peer(sys.argv[1])
    executor = SingleThreadedExecutor()
    executor.add_node(peer.node)

    def spin() -> None:
        with contextlib.suppress(ExternalShutdownException):
            executor.spin()

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    for line in sys.stdin:
        command = json.loads(line)
        try:
            answer = getattr(peer, command["do"])(command)
        except Exception as error:  # the test shows it
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), flush=True)
    rclpy.shutdown()
    thread.join(5.0)


if __name__ == "__main__":
    main()
