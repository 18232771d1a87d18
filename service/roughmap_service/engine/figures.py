"""The figures of a lost cloud or pose: what was found, against the limit that it broke, and what would mend it.

They are looked up when a sentence is made of them, not for each message; see `inputs/streams.py`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import sqrt

import numpy as np

from roughmap import RoughMap
from roughmap.cell import TILE_CELLS
from roughmap_schemas import IntegrationEvent, PoseReason, SensorConfig
from roughmap_service.inputs.losses import cloud_cause
from roughmap_service.inputs.remedies import Figures, robot_table, sensor_table, time_form_remedy
from roughmap_service.run.inbox import LoggedCloud
from roughmap_service.run.poses import Pose
from roughmap_service.run.robot import Robot
from roughmap_service.run.settings import Settings

NOTHING = Figures()

LARGE = 1e6
"""Metres from which on decimals say nothing."""

CLOCK_S = 1.0
"""Seconds between a cloud's stamp and the newest pose from which on different clocks are likelier than slow poses."""

SWEEP_S = 0.5
"""Seconds from a cloud's first point to its last from which on a wrong unit is likelier than late poses."""

LATE_S = 10.0
"""Seconds by which a localisation may be late, at most."""

LOOKED_AT = 2000
"""Points of a cloud that are looked at."""

KNOWN_FRAMES = 5
"""Frames that are listed."""


@dataclass(frozen=True)
class LostCloud:
    """A decided cloud, and what decided it: its robot (None if it never sent a pose), how long it waited in s, and what
    was seen of its points' times if their meaning is unclear."""

    cloud: LoggedCloud
    event: IntegrationEvent
    robot: Robot | None
    settings: Settings
    map: RoughMap
    waited: float
    seen: str = ""

    def figures(self) -> Figures:
        """Return the figures of the cause that the cloud is counted under."""
        rejected = {str(reason): number for reason, number in self.event.rejected.items()}
        cause = cloud_cause(self.event.outcome, self.event.accepted, rejected)
        find = FINDERS.get(cause) if cause is not None else None
        return NOTHING if find is None else find(self)

    @property
    def table(self) -> str:
        """The head of the table with its sensor's settings."""
        return sensor_table(self.settings.config, self.cloud.robot, self.frame_id)

    @property
    def frame_id(self) -> str:
        """The cloud's frame."""
        return self.cloud.cloud.frame_id

    @property
    def sensor(self) -> SensorConfig | None:
        """The settings of its sensor; None for a cloud in the map's frame."""
        return self.settings.config.sensor(self.cloud.robot, self.frame_id)

    def poses(self) -> list[Pose]:
        """Return the poses that the event names."""
        return [] if self.robot is None else self.robot.buffer.named(self.event.poses)

    def one_clock(self, ahead: float) -> str:
        """Return the remedy for a sensor whose clock is so many seconds ahead of the robot's."""
        present = 0.0 if self.sensor is None else self.sensor.time_offset
        offset = f"{round(present - ahead, 1) + 0.0}"
        return f"check that {self.frame_id} and odometry use one clock, or set time_offset = {offset} in {self.table}"


def figure(metres: float) -> str:
    """Return a length for a text."""
    return f"{metres:.2f}" if metres < LARGE else f"{metres:.3g}"


def _no_pose(lost: LostCloud) -> Figures:
    robot, cloud = lost.robot, lost.cloud
    if robot is None or not robot.buffer.poses:
        return Figures("no pose of the robot has been taken yet")
    if slow := _slow_odometry(robot, lost.settings):
        return slow
    first, newest = robot.buffer.poses[0].stamp_ns, robot.buffer.poses[-1].stamp_ns
    if cloud.last_ns <= newest:
        if cloud.first_ns >= first:
            return Figures("the robot's stamps were in doubt")
        text = f"they began {max((first - cloud.first_ns) * 1e-9, 0.01):.2g} s before its first pose"
        return Figures(text, "nothing is wrong if it happens once, at a start or after its clock was set", certain=True)
    behind = (cloud.last_ns - newest) * 1e-9
    text = f"the newest pose is {behind:.3g} s behind after {lost.waited:.3g} s" if behind < CLOCK_S else ""
    # Poses went on while the cloud waited.
    ahead = behind + lost.waited
    text = text or f"the newest pose is {ahead:.1f} s behind"
    if ahead <= lost.settings.max_wait + CLOCK_S:
        if (lasts := (cloud.last_ns - cloud.first_ns) * 1e-9) > SWEEP_S:
            text = f"{text}; the times of their points span {lasts:.2g} s"
            return Figures(text, f"check time_field and time_unit in {lost.table}, or raise input.max_wait")
        return Figures(text, "publish its poses sooner or more often, or raise input.max_wait")
    late = f"; raise input.max_wait if its poses come {ahead:.1f} s late" if ahead < LATE_S else ""
    return Figures(text, lost.one_clock(ahead) + late)


def _slow_odometry(robot: Robot, settings: Settings) -> Figures | None:
    """Return the figures of odometry that is held, since its stamps are too far apart; None if it is not."""
    stamps = [robot.clock.newest_ns, *(one.stamp_ns for one in robot.clock.held)]
    steps = [after - before for before, after in pairwise(stamps)]
    if not steps or not settings.max_pose_gap_ns < min(steps) <= settings.history_ns:
        return None
    limit, enough = settings.max_pose_gap_ns * 1e-9, 1.5 * min(steps) * 1e-9
    text = f"the robot's poses are {min(steps) * 1e-9:.2g} s apart (input.max_pose_gap = {limit:g})"
    values = f"max_pose_gap = {enough:.1f} and max_wait = {max(enough, settings.max_wait):.1f} in [input]"
    return Figures(text, f"publish poses more often, or set {values}", certain=True)


def _late(lost: LostCloud) -> Figures:
    newest = -1 if lost.robot is None else lost.robot.clock.newest_ns
    if newest < 0:
        return NOTHING
    behind = (newest - lost.cloud.cloud.stamp_ns) * 1e-9
    longer = f"; raise input.pose_history if its clouds take {behind:.0f} s"
    return Figures(f"their stamps are {behind:.1f} s behind the newest pose", lost.one_clock(-behind) + longer)


def _clock_offset(lost: LostCloud) -> Figures:
    robot = lost.robot
    sensor = None if robot is None else robot.sensors.get(lost.frame_id)
    if robot is None or sensor is None:
        return NOTHING
    if sensor.offset_ns:
        ahead = sensor.offset_ns * 1e-9
        if abs(ahead - (lost.cloud.cloud.stamp_ns - robot.clock.newest_ns) * 1e-9) > CLOCK_S:
            return Figures(f"it moved by {abs(ahead):.1f} s against the robot's")  # from where is not known
        return Figures(f"it is {abs(ahead):.1f} s {'ahead' if ahead > 0 else 'behind'}", lost.one_clock(ahead))
    if sensor.same:
        text = f"{sensor.same + 1} clouds in a row have one stamp"
        return Figures(text, "let its driver stamp each cloud with its own time")
    return Figures(f"its stamps fell back by {(sensor.confirmed_ns - sensor.last_ns) * 1e-9:.1f} s")


def _pose_gap(lost: LostCloud) -> Figures:
    gap = max((b.stamp_ns - a.stamp_ns for a, b in pairwise(lost.poses())), default=0)
    return Figures(f"two of them are {gap * 1e-9:.3g} s apart")


def _pose_jump(lost: LostCloud) -> Figures:
    for before, pose in pairwise(lost.poses()):
        if pose.leapt:
            metres, seconds = math.dist(before.position, pose.position), (pose.stamp_ns - before.stamp_ns) * 1e-9
            limit = f"input.max_leap = {lost.settings.max_leap:g}"
            return Figures(f"it moved {figure(metres)} m in {seconds:.3g} s ({limit})")
    return NOTHING


def _too_many_tiles(lost: LostCloud) -> Figures:
    limits, number = lost.settings, lost.map.tile_count
    if number >= limits.max_tiles:
        return Figures(f"the map has {number} tiles (map.max_tiles)", "raise map.max_tiles, or set map.bounds")
    side = TILE_CELLS * limits.config.map.cell_size
    reach = side * sqrt(limits.max_new_tiles / math.pi)
    far = f"points are up to {_distances(lost)[-1]:.0f} m away, and " if len(_distances(lost)) else ""
    text = f"{far}{limits.max_new_tiles} tiles (map.max_new_tiles) of {side:.3g} m cover {reach:.0f} m around the robot"
    if lost.sensor is None:
        return Figures(text, "raise map.cell_size or map.max_new_tiles")
    return Figures(text)


def _uncertain(lost: LostCloud) -> Figures:
    if lost.sensor is None:
        return Figures("their points have input.placed_sigma", "lower input.placed_sigma")
    poses = lost.poses()
    if not poses:
        return NOTHING
    known = poses[-1].covariance
    variances = (lost.settings.pose_covariance if known is None else known).diagonal().tolist()
    cap = _capped(lost, known=known is not None)
    return _uncertain_pose(lost, variances, cap) or _uncertain_far(lost, lost.sensor, variances, cap)


def _limits(lost: LostCloud) -> tuple[tuple[float, str], tuple[float, str]]:
    """Return the limits on a point's error, across and up, in m, and how to show them."""
    m = lost.settings.config.map
    widest, highest = m.max_horizontal_radius, m.max_vertical_sigma
    shown = f"map.max_horizontal_radius = {widest:g}", f"map.max_vertical_sigma = {highest:g}"
    return (math.inf if m.error_model == "point" else widest, shown[0]), (highest, shown[1])


def _uncertain_pose(lost: LostCloud, variances: Sequence[float], cap: str) -> Figures | None:
    """Return the figures if the pose, with these ``variances`` (6,), is too uncertain by itself; else None."""
    k, (widest, highest) = lost.settings.config.map.coverage, _limits(lost)
    across, up = k * sqrt(max(variances[0], variances[1], 0.0)), sqrt(max(variances[2], 0.0))
    if across > widest[0]:
        text = f"{k:g} sigma = {across:.2f} m, {widest[1]}; the pose covariance alone is larger"
    elif up > highest[0]:
        text = f"sigma z = {up:.2f} m, {highest[1]}; the pose covariance alone is larger"
    else:
        return None
    return Figures(text, f"{cap}, or raise the limit")


def _uncertain_far(lost: LostCloud, sensor: SensorConfig, variances: Sequence[float], cap: str) -> Figures:
    """Return from which distance on points are too uncertain: errors of angles grow with it."""
    k, (widest, highest) = lost.settings.config.map.coverage, _limits(lost)
    mount = sensor.mount_sigma
    across = math.hypot(sqrt(max(variances[0], variances[1], 0.0)), sensor.range_sigma, max(mount[0], mount[1]))
    up = math.hypot(sqrt(max(variances[2], 0.0)), sensor.range_sigma, mount[2])
    heading = math.hypot(sqrt(max(variances[5], 0.0)), sensor.beam_sigma, mount[5])
    tilt = math.hypot(sqrt(max(variances[3], variances[4], 0.0)), sensor.beam_sigma, max(mount[3], mount[4]))
    ranges = _reach(widest[0] / k, across, heading), _reach(highest[0], up, tilt)
    errors = f"check range_sigma, beam_sigma and mount_sigma in {lost.table}"
    if ranges[1] < ranges[0]:
        nearest, name, angle, limit, of_pose = ranges[1], "tilt", tilt, highest[1], max(variances[3], variances[4])
        beside = f"sigma z = {up:.2f} m"
    else:
        nearest, name, angle, limit, of_pose = ranges[0], "heading", heading, widest[1], variances[5]
        beside = f"{k:g} sigma = {k * across:.2f} m"
    if nearest == 0.0:
        return Figures(f"{beside} with range_sigma and mount_sigma, {limit}", errors)
    if not math.isfinite(nearest):
        return NOTHING
    text = f"beyond {nearest:.1f} m they are over {limit}: sigma of the {name} is {angle:.3g} rad"
    return Figures(text, cap if 2.0 * of_pose > angle * angle else errors)


def _capped(lost: LostCloud, *, known: bool) -> str:
    """Return the remedy for a pose's covariance that is too large; ``known``: it is not input.pose_sigma's."""
    policy = lost.settings.config.pose_covariance(lost.cloud.robot)
    if not known or policy in ("cap", "configured"):
        return "lower input.pose_sigma"
    return f'cap it ({robot_table(lost.cloud.robot)} pose_covariance = "cap")'


def _reach(limit: float, sigma: float, angle: float) -> float:
    """Return the distance at which an error of ``sigma`` m and ``angle`` rad reaches the limit (m), from 0 on."""
    left = limit * limit - sigma * sigma
    if left <= 0.0:
        return 0.0
    return sqrt(left) / angle if angle > 0.0 else math.inf


def _range(lost: LostCloud) -> Figures:
    distances, s = _distances(lost), lost.sensor
    if s is None or not len(distances):
        return NOTHING
    middle = distances[len(distances) // 2]
    return Figures(f"half of them are within {middle:.3g} m (min_range = {s.min_range:g}, max_range = {s.max_range:g})")


def _distances(lost: LostCloud) -> Sequence[float]:
    """Return the distances of some points from the sensor in m, ascending; of those that are finite and not zero."""
    points = lost.cloud.cloud.points
    some = points[:: max(len(points) // LOOKED_AT, 1)].astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        square = (some * some).sum(axis=1)
    kept: list[float] = np.sort(np.sqrt(square[np.isfinite(square) & (square > 0.0)])).tolist()
    return kept


def _bounds(lost: LostCloud) -> Figures:
    poses = lost.poses()
    where = "" if not poses else f"the robot is at x = {poses[-1].position[0]:.1f}, y = {poses[-1].position[1]:.1f}; "
    return Figures(f"{where}map.bounds = {list(lost.settings.config.map.bounds or ())}")


FINDERS: dict[tuple[str, str], Callable[[LostCloud], Figures]] = {
    ("cloud", "no_pose"): _no_pose,
    ("cloud", "late"): _late,
    ("cloud", "clock_offset"): _clock_offset,
    ("cloud", "time_form"): lambda lost: Figures(lost.seen, time_form_remedy(lost.seen, lost.table)),
    ("cloud", "pose_gap"): _pose_gap,
    ("cloud", "pose_jump"): _pose_jump,
    ("cloud", "too_many_tiles"): _too_many_tiles,
    ("point", "uncertain"): _uncertain,
    ("point", "range"): _range,
    ("point", "bounds"): _bounds,
}
"""By kind and reason of the cause."""


def pose_figures(reason: str | None, stamp_ns: int, frame_id: str, robot: Robot, why: str = "") -> Figures:
    """Return the figures of an odometry that gave no pose, of that stamp and frame; ``why`` as in `OdometryTaken`."""
    ahead = (stamp_ns - robot.clock.newest_ns) * 1e-9
    if reason == PoseReason.POSE_FRAME and not why:
        known = ", ".join(f'"{frame}"' for frame in list(robot.transforms.rows)[:KNOWN_FRAMES])
        known = f"transforms are known from {known}" if known else "no transform is known"
        text = f'their frame is "{frame_id}"; {known}'
        map_frame = robot.settings.frame_id
        if frame_id.strip("/") == map_frame:
            return Figures(text, f'write their frame as "{map_frame}"')
        return Figures(text)
    if reason == PoseReason.AHEAD and ahead > 0.0:
        return Figures(f"{ahead:.1f} s ahead of the newest pose")
    if reason in (PoseReason.STALE, PoseReason.OUT_OF_ORDER) and ahead < 0.0:
        return Figures(f"{-ahead:.1f} s behind the newest pose")
    return Figures(why)
