"""What of `[ros2]` can't work, by the configuration alone."""

import re

import zenoh

from roughmap_ros.out.topics import topic_of
from roughmap_ros.out.window import window
from roughmap_ros.wire import enable_timestamps, router_problem
from roughmap_schemas import Config, ConfigFault
from roughmap_schemas.layers import layers_of
from roughmap_schemas.ros2_sections import TOPIC_PATTERN


def prepare(session_config: zenoh.Config, config: Config) -> None:
    """Make a session's configuration fit for ROS 2, if ``[ros2]`` says anything; ConfigFault if it can't be done."""
    if config.ros2.active:
        check_topics(config)
        enable_timestamps(session_config)


def check_topics(config: Config) -> None:
    """Raise ConfigFault for a topic of ``[ros2.out]`` that can never be published."""
    layers, most = layers_of(config.map.surface), config.query.max_region_cells
    taken = {topic: "read" for robot in config.ros2.robots.values() for topic, _ in robot.roles}
    for name, out in config.ros2.out.items():
        topic = topic_of(name, out)
        if re.fullmatch(TOPIC_PATTERN, topic) is None:
            raise ConfigFault(f"ros2.out.{name}: {topic!r} is no ROS topic; set topic")
        for own in (topic, f"{topic}_updates") if out.type == "OccupancyGrid" else (topic,):
            if own in taken:
                raise ConfigFault(f"ros2.out.{name}: {own} is {taken[own]} already; set another topic")
            taken[own] = f"published by ros2.out.{name}"
        missing = [layer for layer in out.layers if layer not in layers]
        if missing:
            raise ConfigFault(f"ros2.out.{name}.layers: a map with surface {config.map.surface!r} has no {missing[0]}")
        if out.level >= config.map.levels:
            raise ConfigFault(
                f"ros2.out.{name}.level: must be below map.levels ({config.map.levels}); found {out.level}"
            )
        try:
            cells = window(out, config.map.cell_size, (0.0, 0.0))
        except OverflowError:
            raise ConfigFault(f"ros2.out.{name}: its window is no size of a map; set a smaller size or box") from None
        if cells is not None and cells.nx * cells.ny > most:
            text = f"its window has {cells.nx} x {cells.ny} cells (query.max_region_cells: {most})"
            raise ConfigFault(f"ros2.out.{name}: {text}; set a smaller size or box, or a higher level")


def standing(config: Config) -> str | None:
    """Say how the service's session keeps ROS nodes from finding each other or itself; None if all is well."""
    zenoh = config.zenoh
    if zenoh.config_file:  # it may say all of this otherwise
        return None
    return router_problem(zenoh.mode, zenoh.listen, config.ros2.keys, scouting=zenoh.scouting)
