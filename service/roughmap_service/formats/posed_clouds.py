"""The clouds of a recording with the poses of a trajectory beside it, as kiss-icp writes one.

Its poses are those of the sensor, unless the sensor is configured with a place on the robot. Stamps of poses are those
of the clouds' headers, or the times at which the clouds were recorded, which kiss-icp writes for bags; the poses then
belong to the clouds' own stamps. So do poses without stamps, one for each cloud.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from roughmap_ros.messages import BadRosMessage, cloud_message, livox_message
from roughmap_ros.messages.cdr import read_header
from roughmap_schemas.geometry import SECOND_NS
from roughmap_schemas.kinds import Kind, RobotMessage
from roughmap_schemas.odometry import encode_odometry
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import CloudFileFault, Contents
from roughmap_service.formats.robot_messages import Source, frame_of, frames_of, robot_messages
from roughmap_service.formats.topics import Topic, choose
from roughmap_service.formats.trajectories import PoseFile, read_trajectory

AHEAD_NS: Final = 1_000_000_000
"""Poses so far after a cloud's stamp come before the cloud: its last point may be later than its stamp."""

ROUNDED_NS: Final = 100_000
"""Stamps written with four decimals differ by up to half of this from what they were."""


def messages_of(source: Source, options: ReadOptions) -> Iterator[Contents | RobotMessage]:
    """Return a robot's messages, with the poses of the recording or of the trajectory. Raises CloudFileFault."""
    return robot_messages(source, options) if options.poses is None else posed_clouds(source, options)


def posed_clouds(source: Source, options: ReadOptions) -> Iterator[Contents | RobotMessage]:
    """Return the clouds in order, before each the poses around it. Raises CloudFileFault and OSError."""
    assert options.poses is not None  # noqa: S101 - the caller has looked
    trajectory = read_trajectory(options.poses)
    frames = _frames(source, options)
    clouds = list(frames)
    numbered = _numbered(source, trajectory, clouds, options.poses)
    read = {topic.name: livox_message if topic.role == "livox" else cloud_message for topic in clouds}
    yield Contents(options.map_frame, placed=frozenset(frames.values()))
    poses: _Poses | None = None
    span = max(source.end_ns - source.start_ns, 1)
    for number, raw in enumerate(source.messages(read)):
        options.reached((raw.log_ns - source.start_ns) / span)
        try:
            cloud, stamp_ns = read[raw.topic](raw.data, raw.log_ns), read_header(raw.data).stamp_ns
        except BadRosMessage as error:
            options.note(f"{source.path}: {raw.topic}: a cloud was left out: {error}")
            continue
        poses = poses or _Poses(trajectory, options.map_frame, by_log=_by_log(trajectory, stamp_ns, raw.log_ns))
        if numbered:
            yield poses.message(number, stamp_ns, raw.log_ns)
        else:
            yield from poses.before(stamp_ns, raw.log_ns)
        yield cloud
    options.reached(1.0)
    if poses is not None and not numbered:
        yield from poses.rest(source.end_ns)


def _frames(source: Source, options: ReadOptions) -> Mapping[Topic, str]:
    """Return the topics of the clouds, with the frame of each."""
    if options.topics is None:
        return choose(source.path, source.topics, partial(frame_of, source), options).clouds
    return frames_of(source, options.topics)


def _numbered(source: Source, trajectory: PoseFile, clouds: Sequence[Topic], file: Path) -> bool:
    """Return whether the poses have no stamps but numbers; CloudFileFault unless there is one for each cloud."""
    poses, number = len(trajectory.stamps), sum(topic.messages for topic in clouds)
    if not np.array_equal(trajectory.stamps, np.arange(poses) * SECOND_NS):
        return False
    if poses != number:
        raise CloudFileFault(
            f"{file}: {poses:,} poses without stamps for the {number:,} clouds of {source.path}; give one for each, or "
            "poses with stamps (TUM)"
        )
    return True


def _by_log(trajectory: PoseFile, stamp_ns: int, log_ns: int) -> bool:
    """Return whether the trajectory has a pose at the time at which a cloud was recorded, and none at its stamp."""
    return _nearest(trajectory, stamp_ns) is None and _nearest(trajectory, log_ns) is not None


def _nearest(trajectory: PoseFile, time_ns: int) -> int | None:
    """Return which pose is of that time, but for rounding; None if none is."""
    after = int(np.searchsorted(trajectory.stamps, time_ns - ROUNDED_NS))
    near = after < len(trajectory.stamps) and int(trajectory.stamps[after]) <= time_ns + ROUNDED_NS
    return after if near else None


class _Poses:
    """The poses of a trajectory in the order in which clouds need them."""

    def __init__(self, trajectory: PoseFile, map_frame: str, *, by_log: bool) -> None:
        self._trajectory = trajectory
        self._map_frame = map_frame
        self._by_log = by_log
        self._next = 0

    def before(self, stamp_ns: int, log_ns: int) -> Iterator[RobotMessage]:
        """Return the poses that come before a cloud."""
        if self._by_log:
            k = _nearest(self._trajectory, log_ns)
            if k is not None:
                yield self.message(k, stamp_ns, log_ns)
            return
        stamps = self._trajectory.stamps
        while self._next < len(stamps) and stamps[self._next] <= stamp_ns + AHEAD_NS:
            yield self.message(self._next, int(stamps[self._next]), log_ns)
            self._next += 1

    def rest(self, log_ns: int) -> Iterator[RobotMessage]:
        """Return the next pose after all clouds."""
        if not self._by_log and self._next < len(self._trajectory.stamps):
            yield self.message(self._next, int(self._trajectory.stamps[self._next]), log_ns)

    def message(self, k: int, stamp_ns: int, log_ns: int) -> RobotMessage:
        """Return the k-th pose as the one at a stamp."""
        position, rotation = self._trajectory.positions[k], self._trajectory.rotations[k]
        payload = encode_odometry(stamp_ns, self._map_frame, position, rotation)
        return RobotMessage(Kind.ODOMETRY, payload, log_ns)
