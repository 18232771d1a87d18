"""`roughmap ros2`: the bridge to ROS 2 as a process of its own, beside a running service."""

import json
import logging
import signal
import sys
import threading
from contextlib import ExitStack
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

import click

from roughmap_service.cli.options import BadUse, Failure, config_options, connect_option, endpoint, load, zenoh_option

if TYPE_CHECKING:
    from roughmap_schemas.config_load import LoadedConfig
    from roughmap_schemas.kinds import Kind

logger = logging.getLogger(__name__)


@click.command
@connect_option
@zenoh_option
@click.option(
    "--ros",
    type=endpoint,
    metavar="ENDPOINT",
    help="Zenoh router of the ROS nodes. [default: where the service is]",
)
@click.option(
    "--wait",
    type=click.FloatRange(0, 3600),
    default=15.0,
    show_default=True,
    help="How long to wait for the service, in seconds.",
)
@config_options
def ros2(
    connect: tuple[str, ...],
    zenoh_file: Path | None,
    ros: str | None,
    wait: float,
    config_path: Path | None,
    settings: tuple[tuple[str, object], ...],
) -> None:
    """roughmap ros2 --set 'ros2.out={"costmap": {"type": "OccupancyGrid", "box": [-20, -20, 20, 20]}}'

    Take part in ROS 2 for a running service, until Ctrl-C: read clouds, poses and transforms of ROS topics, and publish
    parts of the map, as [ros2] says. `roughmap serve` does the same by itself if its configuration has [ros2]; use one
    of them, not both. The line above publishes the map around its origin on /roughmap/costmap. When everything is
    declared, it prints one JSON line on stdout; log lines go to stderr.

    ROS nodes with rmw_zenoh need a Zenoh router: run rmw_zenohd and pass it with --ros, or run the service with
    zenoh.mode = "router". With other middleware, set ros2.keys = "ros2dds" and run zenoh-bridge-ros2dds.

    An OccupancyGrid has 0 where traversability is 1, 100 where it is 0, and -1 where it is unknown. Nav2's static layer
    takes everything below 100 as free, unless its trinary_costmap is false; or set a threshold, such as
    threshold = 0.3: then cells below it are 100 and all others 0. Each OccupancyGrid has a service TOPIC/get_map.
    """
    from roughmap_client import RoughMapError
    from roughmap_service.host.log_lines import set_up
    from roughmap_service.inputs.ros2_checks import check_topics

    loaded = load(config_path, settings)
    config = loaded.config
    if not config.ros2.active:
        raise BadUse("nothing to do: configure [ros2.robots.NAME] or [ros2.out.NAME]")
    check_topics(config)
    set_up(config.service.log_format, config.service.log_level, sys.stderr)
    stop = threading.Event()

    def end(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGINT, end)
    try:
        _run(loaded, connect, zenoh_file, ros, wait, stop)
    except RoughMapError as error:
        raise Failure(f"{error}; is the map {config.map.name!r} served there? (--connect, map.name)") from error


def _run(
    loaded: "LoadedConfig",
    connect: tuple[str, ...],
    zenoh_file: Path | None,
    ros: str | None,
    wait: float,
    stop: threading.Event,
) -> None:
    from roughmap_client import RoughMapClient
    from roughmap_ros.bridge import Bridge, robot_feeds, ros_node
    from roughmap_ros.key_sink import KeySink
    from roughmap_ros.wire import enable_timestamps
    from roughmap_schemas import Keys
    from roughmap_service.cli.connection import client_config, open_client
    from roughmap_service.inputs.ros2 import QUERY_S
    from roughmap_service.inputs.ros2_problems import Told

    config = loaded.config
    with ExitStack() as stack:
        zenoh_config = client_config(loaded, connect, zenoh_file)
        enable_timestamps(zenoh_config)
        session = stack.enter_context(open_client(zenoh_config, wait))
        ros_session = session
        if ros is not None:
            ros_config = client_config(loaded, [ros])
            enable_timestamps(ros_config)
            ros_session = stack.enter_context(open_client(ros_config, wait))
        client = RoughMapClient(config.map.name, session=session, timeout=QUERY_S, keys=config.keys)
        status = client.status(timeout=wait)
        node = stack.enter_context(ros_node(ros_session, config))
        sink = KeySink(session, Keys(config.map.name, config.keys))
        feeds = robot_feeds(config, status.frame_id)
        bridge = stack.enter_context(Bridge(node, config.ros2, feeds, sink.put, _refuse, client))
        click.echo(json.dumps({"ready": True, "map": config.map.name, "node": config.ros2.node}))
        stack.enter_context(Told(bridge.problems))
        stop.wait()


def _refuse(robot: str, kind: "Kind", text: str) -> None:
    from roughmap_service.host.log_lines import note

    text = f"robot {robot}: message not used: {text}"
    note(logger, logging.WARNING, "refused", text, robot=robot, reason=kind.value)
