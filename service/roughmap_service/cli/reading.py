"""Options of the commands that read recordings."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from roughmap_service.cli.options import BadUse

if TYPE_CHECKING:
    from roughmap_schemas import Config
    from roughmap_service.formats.options import ReadOptions

F = TypeVar("F", bound=Callable[..., Any])


def reading_options(function: F) -> F:
    """Add the options of `read_options`."""
    for option in (
        click.option(
            "--scan-seconds",
            type=click.FloatRange(0.001, 3600),
            metavar="SECONDS",
            help="Read points with times of their own, as in LAS, as scans of so many seconds.",
        ),
        click.option(
            "--poses",
            type=click.Path(exists=True, dir_okay=False, path_type=Path),
            metavar="FILE",
            help="Trajectory for clouds without poses: of TUM (stamp x y z qx qy qz qw) or KITTI.",
        ),
        click.option("--odometry", metavar="TOPIC", help="Topic of the poses in a bag, if it has several."),
        click.option(
            "--clouds",
            "topics",
            multiple=True,
            metavar="TOPIC",
            help="Topic of the clouds in a bag, if it has several. Can be repeated.",
        ),
    ):
        function = option(function)
    return function


def read_options(config: "Config", robot: str | None, given: Mapping[str, Any], *, any_sensor: bool) -> "ReadOptions":
    """Return what the readers are told: by the options `given` and, for the robot's topics, by [ros2.robots]."""
    from roughmap_service.formats.options import ReadOptions

    clouds, odometry = tuple(given["topics"]), given["odometry"]
    known = None if clouds or odometry or robot is None else config.ros2.robots.get(robot)
    return ReadOptions(
        scan_seconds=given["scan_seconds"],
        poses=given["poses"],
        topics=known,
        clouds=clouds,
        odometry=odometry,
        map_frame=config.map.frame_id,
        sensors=config.sensors_of(robot or ""),
        any_sensor=any_sensor,
    )


def only_robot(config: "Config", robot: str | None) -> str:
    """Return the name of the robot that recordings are of: as given, else the only one in [ros2.robots], else robot."""
    if robot is not None:
        return robot
    robots = list(config.ros2.robots)
    if len(robots) > 1:
        raise BadUse(f"several robots in ros2.robots ({', '.join(robots)}); choose by --robot NAME")
    return robots[0] if robots else "robot"
