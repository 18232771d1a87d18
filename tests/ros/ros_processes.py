"""Processes with real ROS 2: `Peer`, a node that does what a test tells it, and roughmap's node."""

import base64
import contextlib
import json
import os
import signal
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from environments import NODE_PACKAGE, THIS, ros_environment

HERE = Path(__file__).resolve().parent
STOP_S = 30.0


class Ros(NamedTuple):
    """An environment with ROS: the folder of its Python, and of a colcon workspace if there is one."""

    name: str
    folder: Path
    workspace: Path | None
    domain: int

    def start(self, command: list[str | Path], **options: Any) -> subprocess.Popen[str]:
        """Start a program as a shell would that has sourced ROS's setup files."""
        environment = ros_environment(self.folder) | {
            "ROS_DOMAIN_ID": str(self.domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_HOME": str(options.pop("home")),
            "PYTHONUNBUFFERED": "1",
        }
        words = [str(word) for word in command]
        if self.workspace is not None:
            setup = self.workspace / "install/local_setup.sh"
            words = ["sh", "-c", f'cd "{self.workspace}/install" && . {setup} && exec "$@"', "sh", *words]
        return subprocess.Popen(words, env=environment, text=True, **options)


def environment(root: Path, name: str) -> Ros:
    """Return an environment that run.py has made."""
    return Ros(name, root / name, root / "colcon" if name == THIS.name else None, free_domain())


def free_domain() -> int:
    """Return a ROS domain on whose ports nobody listens on this machine."""
    for number in range(80):
        domain = 10 + (os.getpid() + number) % 80
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("127.0.0.1", 7400 + 250 * domain + 10))
            except OSError:
                continue
            return domain
    raise AssertionError("no free ROS domain")


class Peer:
    """A real rclpy node in a process of its own."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def ask(self, do: str, **command: Any) -> dict[str, Any]:
        """Send a command of ros_peer.py; return its answer."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps({"do": do, **command}) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        assert line, f"{do}: the ROS peer has ended"
        answer: dict[str, Any] = json.loads(line)
        assert "error" not in answer, f"{do} {command}: {answer['error']}"
        return answer

    def publish(self, topic: str, **message: Any) -> bytes:
        """Publish a message; return the bytes that rclpy has made of it."""
        return base64.b64decode(self.ask("publish", topic=topic, message=message)["cdr"])

    def serialise(self, ros_type: str, **message: Any) -> bytes:
        """Return the bytes that rclpy makes of a message."""
        return base64.b64decode(self.ask("serialise", type=ros_type, message=message)["cdr"])

    def received(self, topic: str, ros_type: str, count: int = 1) -> tuple[list[bytes], str]:
        """Wait for messages; return their bytes and the newest as text."""
        answer = self.ask("received", topic=topic, type=ros_type, count=count)
        return [base64.b64decode(one) for one in answer["cdr"]], answer["text"]


@contextlib.contextmanager
def peer(ros: Ros, home: Path, name: str = "robot") -> Iterator[Peer]:
    """Run a ROS node that does what it is told."""
    python = ros.folder / "bin/python"
    process = ros.start([python, HERE / "ros_peer.py", name], home=home, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    with process:
        try:
            yield Peer(process)
        finally:
            assert process.stdin is not None
            process.stdin.close()
            stop(process)


@contextlib.contextmanager
def roughmap_node(ros: Ros, home: Path, endpoint: str, **topics: list[str]) -> Iterator[Path]:
    """Run roughmap's node until the block ends; yield the file with its log. It must end with exit code 0."""
    parameters = {"endpoint": endpoint, **topics}
    chosen = [word for name, value in parameters.items() for word in ("-p", f"{name}:={json.dumps(value)}")]
    script = NODE_PACKAGE / "roughmap_ros_node/node.py"
    program: list[str | Path] = [ros.folder / "bin/python", script]
    if ros.workspace is not None:
        program = [ros.workspace / "install/lib/roughmap_ros/node"]
    log = home / "node.log"
    with log.open("w") as written:
        process = ros.start([*program, "--ros-args", *chosen], home=home, stdout=written, stderr=subprocess.STDOUT)
        with process:
            try:
                yield log
            except BaseException:
                print(log.read_text())
                raise
            finally:
                process.send_signal(signal.SIGINT)
                code = stop(process)
    assert code == 0, log.read_text()
    assert "Traceback" not in log.read_text(), log.read_text()


def stop(process: subprocess.Popen[str]) -> int:
    """Wait for a process's end; kill it if it does not come."""
    try:
        return process.wait(STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait(STOP_S)
