"""One robot: what its odometry, transforms and clouds' stamps lead to, in the order of their arrival."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from roughmap_schemas import Odometry, PoseReason, Transform
from roughmap_schemas.geometry import multiply, rotation_matrix
from roughmap_service.run.covariances import BadCovariance, Settled, settle
from roughmap_service.run.leaps import Leap, find_leap
from roughmap_service.run.mountings import Mounted, Mounting, Mountings
from roughmap_service.run.odometry_clock import BACK_FENCE_NS, BELIEVED, BREAK_FENCE_NS, Held, OdometryClock, Verdict
from roughmap_service.run.pose_algebra import quaternion, rotate, triple, turn_covariance
from roughmap_service.run.poses import Pose, PoseBuffer
from roughmap_service.run.rules_1 import StampOrder
from roughmap_service.run.sensor_clock import SensorClock
from roughmap_service.run.settings import Settings
from roughmap_service.run.transforms import StampedTransform, Transforms


@dataclass(frozen=True, slots=True)
class OdometryTaken:
    """What an odometry led to.

    Attributes:
        settled: what became of each message that is settled now: why it gives no pose, None if it does. Empty while
            this one is held; more than one if others were held before it.
        stamps: their stamps in ns.
        verdict: what the stamps said.
        ended_from: clouds from this input number on may have been made before the robot's clock went back; 0: none.
        leap: the leap that the pose is.
        unestimated: whether the message had no estimate of some of its covariance.
        leapt_s: how far the clock leapt forward, in s.
        why: what is wrong with its position or covariance, if that takes words.
    """

    settled: Sequence[PoseReason | None]
    stamps: Sequence[int] = ()
    verdict: Verdict = Verdict.TAKE
    ended_from: int = 0
    leap: Leap | None = None
    unestimated: bool = False
    leapt_s: float = 0.0
    why: str = ""


class _Read(NamedTuple):
    """What an odometry says: a pose, or the reason why it gives none, and ``why`` as in `OdometryTaken`."""

    pose: Pose | PoseReason
    why: str = ""
    unestimated: bool = False


@dataclass
class Robot:
    """The state of one robot. It depends on nothing but the messages and their order, so a replay has the same."""

    settings: Settings
    name: str
    buffer: PoseBuffer = field(init=False)
    transforms: Transforms = field(default_factory=Transforms)
    mountings: Mountings = field(default_factory=Mountings)
    clock: OdometryClock = field(default_factory=OdometryClock)
    sensors: dict[str, SensorClock] = field(default_factory=dict)
    order: StampOrder = field(default_factory=StampOrder)

    def __post_init__(self) -> None:
        self.buffer = PoseBuffer(self.settings.history_ns, self.settings.max_poses)

    def use(self, settings: Settings) -> None:
        """Continue under other settings."""
        self.settings = settings
        self.buffer.history_ns, self.buffer.max_poses = settings.history_ns, settings.max_poses

    def judge(self, stamp_ns: int) -> Verdict:
        """Return what becomes of an odometry of this stamp; nothing changes."""
        if self.settings.rules == 1:
            return Verdict.TAKE
        return self.clock.judge(stamp_ns, self.settings.max_pose_gap_ns, self.settings.history_ns)

    def take_odometry(self, odometry: Odometry, number: int, arrival_ns: int) -> OdometryTaken:
        """Take the odometry with this input number; ``arrival_ns`` is its log time."""
        if self.settings.rules == 1:
            return self._take_by_stamp(odometry, number)
        verdict = self.judge(odometry.stamp_ns)
        if verdict is Verdict.REPEAT:
            frozen = self.clock.count_repeat(number)
            reason = PoseReason.FROZEN if frozen else PoseReason.DUPLICATE
            return OdometryTaken([reason], [odometry.stamp_ns], verdict)
        # After a clock went back, transforms' stamps say nothing: the last one holds.
        back = odometry.stamp_ns <= self.clock.newest_ns and self.clock.taken >= BELIEVED
        last = back and not self.clock.two_sources and not self.clock.anew_from
        read = self._read(odometry, number, last=last)
        one = Held(odometry.stamp_ns, number, read.pose)
        if verdict is Verdict.HOLD:
            given_up = self.clock.hold(one)
            lost = [] if given_up is None else [given_up]
            settled, stamps = [self._given_up(h) for h in lost], [h.stamp_ns for h in lost]
            return OdometryTaken(settled, stamps, verdict, unestimated=read.unestimated, why=read.why)
        return replace(self._believe(verdict, one, arrival_ns), unestimated=read.unestimated, why=read.why)

    def add_transform(self, transform: Transform, number: int) -> tuple[PoseReason | None, bool]:
        """Add a transform. Return `pose_frame` if its parent is not the map's frame, and whether it jumped."""
        if transform.parent_frame_id != self.settings.frame_id:
            return PoseReason.POSE_FRAME, False
        s = self.settings
        return None, self.transforms.add(transform, number, s.jump_m, s.jump_rad, s.max_transforms)

    def is_mounting(self, transform: Transform) -> bool:
        """Return whether a transform says where a sensor is mounted: it leads to its frame from the robot's base."""
        s = self.settings
        return transform.parent_frame_id != s.frame_id and s.by_transform(self.name, transform.child_frame_id)

    def mount(self, transform: Transform) -> Mounted | None:
        """Take a transform that says where a sensor is mounted; None if it says nothing of the kind."""
        return self.mountings.take(transform) if self.is_mounting(transform) else None

    def mounting(self, frame_id: str) -> Mounting | None:
        """Return where a sensor with ``extrinsics = "transform"`` is mounted; None if that has not come yet."""
        return self.mountings.rows.get(frame_id)

    def _believe(self, verdict: Verdict, one: Held, arrival_ns: int) -> OdometryTaken:
        """Take a message whose stamp is believed, and with it those held before that belong to it."""
        clock, newest = self.clock, self.clock.newest_ns
        held = clock.release()
        together: list[Held] = []
        ended_from, leapt_ns = 0, 0
        if verdict in (Verdict.FORWARD, Verdict.BACK):
            together = clock.row_of(one.stamp_ns, held, self.settings.max_pose_gap_ns, self.settings.history_ns)
            step_ns = (together[0] if together else one).stamp_ns - newest
            leapt_ns = step_ns if step_ns > self.settings.max_pose_gap_ns else 0
        elif clock.two_sources:
            together = [h for h in held if h.stamp_ns <= newest]
        lost = [h for h in held if h not in together]
        settled: list[PoseReason | None] = [self._given_up(h) for h in lost]
        if verdict is Verdict.BACK and clock.anew_from:  # clouds since the map was emptied are of the new time
            self.buffer.clear()
            clock.begin(clock.anew_from, 0)
            self.transforms.keep_last()
        elif verdict is Verdict.BACK and clock.taken < BELIEVED:  # what came first was wild
            self.buffer.clear()
            clock.begin(clock.begun, 0)
        elif verdict is Verdict.BACK:
            ended_from = clock.last_input + 1
            self._begin_anew(ended_from, together[0].stamp_ns + BACK_FENCE_NS)
            self.transforms.keep_last()
        elif verdict is Verdict.BREAK:
            ended_from = clock.last_input + 1
            clock.count_break(one.stamp_ns, self.settings.history_ns)
            self._begin_anew(ended_from, one.stamp_ns + BREAK_FENCE_NS)
        elif verdict is Verdict.TAKE:
            clock.count_mixed(low=any(h.stamp_ns <= newest for h in held))
        leap: Leap | None = None
        taken = sorted([*together, one], key=lambda h: h.stamp_ns)
        for each in taken:
            why_not, leapt = self._insert(each)
            settled.append(why_not)
            leap = leapt or leap
            for sensor in self.sensors.values():
                sensor.odometry(each.stamp_ns, arrival_ns)
        self.buffer.trim()
        stamps = [h.stamp_ns for h in (*lost, *taken)]
        return OdometryTaken(settled, stamps, verdict, ended_from, leap, leapt_s=leapt_ns * 1e-9)

    def _begin_anew(self, number: int, fence_ns: int) -> None:
        self.buffer.clear()
        self.clock.begin(number, fence_ns)
        for sensor in self.sensors.values():
            if sensor.fell >= number:
                sensor.begin()
            else:
                sensor.fenced = True

    def _insert(self, one: Held) -> tuple[PoseReason | None, Leap | None]:
        """Count a message as taken, and insert its pose. Return why there is none, and the leap that it is."""
        self.clock.take(one.stamp_ns, one.input)
        if isinstance(one.pose, PoseReason):
            return one.pose, None
        if one.stamp_ns < self.buffer.horizon_ns:
            return PoseReason.STALE, None
        at = self.buffer.insert(one.pose)
        if at is None:
            return PoseReason.DUPLICATE, None
        leap = self._mark_leap(at)
        if at + 1 < len(self.buffer.poses):
            self._mark_leap(at + 1)
        return None, leap

    def _mark_leap(self, at: int) -> Leap | None:
        poses, s = self.buffer.poses, self.settings
        leap = find_leap(poses, at, s.max_leap, s.max_acceleration, s.max_speed)
        if poses[at].leapt != (leap is not None):
            poses[at] = replace(poses[at], leapt=leap is not None)
        return leap

    def _given_up(self, held: Held) -> PoseReason:
        if held.stamp_ns > self.clock.newest_ns:
            return PoseReason.AHEAD
        return PoseReason.STALE if held.stamp_ns < self.buffer.horizon_ns else PoseReason.OUT_OF_ORDER

    def _take_by_stamp(self, odometry: Odometry, number: int) -> OdometryTaken:
        pose = self._read(odometry, number).pose
        if isinstance(pose, PoseReason):
            return OdometryTaken([pose], [odometry.stamp_ns])
        reason = self.order.add(self.buffer, pose)
        self.clock.newest_ns = self.buffer.poses[-1].stamp_ns
        return OdometryTaken([reason], [odometry.stamp_ns])

    def _read(self, odometry: Odometry, number: int, *, last: bool = False) -> _Read:
        """Return the pose in the map frame, or why there is none; ``last``: by the transform that came last."""
        position, rotation, transform = triple(odometry.position), quaternion(odometry.rotation), None
        if odometry.frame_id != self.settings.frame_id:
            transform = self._transform(odometry, last=last)
            if transform is None:
                return _Read(PoseReason.POSE_FRAME)
            turn = rotation_matrix(transform.rotation)
            moved, t = rotate(turn, position), transform.translation
            position = t[0] + moved[0], t[1] + moved[1], t[2] + moved[2]
            if not all(map(math.isfinite, position)):  # the sum of finite numbers may overflow
                return _Read(PoseReason.POSE_FRAME, "in the map's frame, their positions overflow")
            rotation = multiply(transform.rotation, rotation)
        try:
            settled = self._covariance(odometry)
            covariance = settled.covariance
            if transform is not None and covariance is not None:
                covariance = turn_covariance(turn, covariance)
                if not np.isfinite(covariance).all():  # the largest numbers may
                    raise BadCovariance("it overflows in map axes")
        except BadCovariance as error:
            return _Read(PoseReason.BAD_COVARIANCE, str(error))
        used = 0 if transform is None else transform.input
        pose = Pose(odometry.stamp_ns, position, rotation, covariance, number, used)
        return _Read(pose, unestimated=bool(settled.unestimated))

    def _transform(self, odometry: Odometry, *, last: bool) -> StampedTransform | None:
        if last:
            return self.transforms.last(odometry.frame_id)
        return self.transforms.find(odometry.frame_id, odometry.stamp_ns, oldest=self.settings.rules > 1)

    def _covariance(self, odometry: Odometry) -> Settled:
        """Return an odometry's covariance as it is used, in its frame's axes. Raises BadCovariance."""
        s, covariance = self.settings, odometry.covariance
        if odometry.covariance_fault:
            raise BadCovariance
        if s.rules > 1:
            return settle(covariance, s.pose_sigma, s.config.pose_covariance(self.name))
        if covariance is not None and (covariance.diagonal() < 0.0).any():
            raise BadCovariance
        return Settled(covariance)

    def begin_map(self, number: int) -> None:
        """Forget the stamps: the map was emptied, and the same recording may be played again from this input on."""
        self.clock.release()
        self.clock.anew_from = number
        for sensor in self.sensors.values():
            sensor.begin()
            sensor.last_ns = sensor.cleared_ns = -1

    def to_state(self) -> dict[str, Any]:
        """Return everything as JSON values."""
        return {
            "poses": self.buffer.to_state(),
            "transforms": self.transforms.to_state(),
            "mountings": self.mountings.to_state(),
            "horizon_ns": self.buffer.horizon_ns,
            "stale": [self.order.stale_row, self.order.stale_stamp_ns],
            "clock": self.clock.to_state(),
            "sensors": {frame: sensor.to_state() for frame, sensor in self.sensors.items()},
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `to_state` returned, here or in a version without mountings or with the rules of 1."""
        self.buffer.poses = [Pose.of_state(pose) for pose in state["poses"]]
        self.buffer.horizon_ns = state["horizon_ns"]
        self.transforms.load_state(state["transforms"])
        self.mountings.load_state(state.get("mountings", {}))
        self.order.stale_row, self.order.stale_stamp_ns = state["stale"]
        if "clock" in state:
            self.clock.load_state(state["clock"])
        elif self.buffer.poses:
            self.clock.newest_ns = self.buffer.poses[-1].stamp_ns
        self.sensors = {frame: SensorClock.of_state(sensor) for frame, sensor in state.get("sensors", {}).items()}
