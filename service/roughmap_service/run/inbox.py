"""Which cloud is decided next, and how: a state machine over clouds, robots and the times given to it."""

from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

from roughmap_schemas import Cloud, CloudReason
from roughmap_service.run.placing import span
from roughmap_service.run.poses import Pose, leaps, too_far_apart
from roughmap_service.run.robot import Robot
from roughmap_service.run.sensor_clock import Doubt
from roughmap_service.run.sensor_times import Reading
from roughmap_service.run.settings import Settings

INTEGRATED = "integrated"

TIME_BYTES = 8
"""Of a point's own time, once it is read."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """When a message arrived, in monotonic s.

    A ``resumed`` cloud waited over a restart. A ``promised`` one did too, or was acknowledged; it is never rejected for
    lack of room.
    """

    at: float
    promised: bool = False
    resumed: bool = False


@dataclass(frozen=True, slots=True)
class LoggedCloud:
    """A logged cloud without a decision: its input number, the time span of its points in ns, its size in bytes."""

    input: int
    robot: str
    cloud: Cloud
    first_ns: int
    last_ns: int
    size: int
    arrival: Arrival
    reading: Reading | None
    """How its points' times were read; None as long as their form is not known, when its span is its stamp."""

    @property
    def timed(self) -> bool:
        """Whether its points' times are known."""
        return self.reading is not None

    @property
    def sensor(self) -> tuple[str, str]:
        """Its robot and frame."""
        return self.robot, self.cloud.frame_id

    @classmethod
    def of(cls, number: int, robot: str, cloud: Cloud, reading: Reading | None, arrival: Arrival) -> Self:
        """Return the cloud of a message, its points' times read if it is known how."""
        size = cloud.held_bytes + (TIME_BYTES * len(cloud.points) if cloud.time_fields else 0)
        untimed = cls(number, robot, cloud, cloud.stamp_ns, cloud.stamp_ns, size, arrival, None)
        return untimed if reading is None else untimed.with_times(reading)

    def with_times(self, reading: Reading) -> Self:
        """Return the cloud with its points' times."""
        timed = reading.apply(self.cloud)
        first_ns, last_ns = span(timed)
        return replace(self, cloud=timed, first_ns=first_ns, last_ns=last_ns, reading=reading)


@dataclass(frozen=True, slots=True)
class Proposal:
    """What to do with a cloud: integrate it with these poses, or reject it for a reason.

    ``poses`` are (odometry input, transform input or 0), ascending by stamp.
    """

    cloud: LoggedCloud
    outcome: str
    poses: tuple[tuple[int, int], ...] = ()


@dataclass(slots=True)
class Row:
    """Clouds in order of arrival; they leave from the front only."""

    clouds: deque[LoggedCloud] = field(default_factory=deque)
    rising: deque[LoggedCloud] = field(default_factory=deque)
    """The clouds that no later one precedes in time: the first holds the earliest point of the row."""

    def append(self, cloud: LoggedCloud) -> None:
        """Add a cloud."""
        self.clouds.append(cloud)
        while self.rising and self.rising[-1].first_ns > cloud.first_ns:
            self.rising.pop()
        self.rising.append(cloud)

    def popleft(self) -> None:
        """Remove the first."""
        if self.rising[0] is self.clouds.popleft():
            self.rising.popleft()


@dataclass(slots=True)
class SensorQueue:
    """One sensor's clouds, published and promised ones in separate rows.

    Thousands may wait, and each message needs the first and the earliest, so both are kept. Only the first of a row
    ever leaves: it is decided or, if published, rejected for lack of room.
    """

    published: Row = field(default_factory=Row)
    promised: Row = field(default_factory=Row)
    size: int = 0

    def append(self, cloud: LoggedCloud) -> None:
        """Add a cloud."""
        (self.promised if cloud.arrival.promised else self.published).append(cloud)
        self.size += cloud.size

    def remove(self, cloud: LoggedCloud) -> None:
        """Remove a cloud, the first of its row."""
        (self.promised if cloud.arrival.promised else self.published).popleft()
        self.size -= cloud.size

    def replace(self, change: Callable[[LoggedCloud], LoggedCloud]) -> None:
        """Put other clouds in the place of these, of the same sizes."""
        for row in self._rows():
            clouds = [change(cloud) for cloud in row.clouds]
            row.clouds.clear()
            row.rising.clear()
            for cloud in clouds:
                row.append(cloud)

    def untimed(self) -> list[LoggedCloud]:
        """The clouds whose times can't be read yet, in order of arrival."""
        clouds = [cloud for row in self._rows() for cloud in row.clouds if not cloud.timed]
        return sorted(clouds, key=lambda cloud: cloud.input)

    def __len__(self) -> int:
        return len(self.published.clouds) + len(self.promised.clouds)

    @property
    def first(self) -> LoggedCloud:
        """The cloud that came first."""
        return min((row.clouds[0] for row in self._rows()), key=lambda cloud: cloud.input)

    @property
    def earliest_ns(self) -> int:
        """The smallest time of a point in any of them, in ns."""
        return min(row.rising[0].first_ns for row in self._rows())

    def _rows(self) -> list[Row]:
        return [row for row in (self.published, self.promised) if row.clouds]


@dataclass
class Inbox:
    """Each sensor's clouds in order of arrival; sensors don't wait for each other.

    ``robots`` and ``doubts`` are the run's. Stamps are never compared with wall time: the only clock is the monotonic
    time of arrivals and of `tick`.
    """

    settings: Settings
    robots: Mapping[str, Robot]
    doubts: Mapping[int, Doubt]
    queues: dict[tuple[str, str], SensorQueue] = field(default_factory=dict)
    ended: deque[Proposal] = field(default_factory=deque)
    size: int = 0

    def has_room(self, size: int) -> bool:
        """Return whether a cloud of ``size`` bytes fits without rejecting another.

        A single cloud always fits: decoded, it may be larger than its message.
        """
        return not self.size or self.size + size <= self.settings.queue_limit

    def feed(self, cloud: LoggedCloud) -> None:
        """Add a logged cloud. Past the limit, reject the oldest published cloud of the robot with most bytes."""
        self.queues.setdefault(cloud.sensor, SensorQueue()).append(cloud)
        self.size += cloud.size
        while self.size > self.settings.queue_limit and self.size > cloud.size:
            victim = self._victim()
            if victim is None:
                return
            self._end(victim, CloudReason.OVERLOAD)

    def holds_before(self, robot: str, stamp_ns: float) -> bool:
        """Return whether a waiting cloud of the robot has a point before that time."""
        return any(of == robot and queue.earliest_ns < stamp_ns for (of, _), queue in self.queues.items())

    def tick(self, now: float) -> Proposal | None:
        """Return the next decision at monotonic time ``now`` (s), or None.

        Sensors take turns, so that a flood from one does not hold up the others.
        """
        if self.ended:
            return self.ended.popleft()
        for sensor, queue in self.queues.items():
            proposal = self._judge(queue.first, now)
            if proposal is not None:
                self.queues[sensor] = self.queues.pop(sensor)  # to the end of the line
                self._remove(proposal.cloud)
                return proposal
        return None

    def deadline(self) -> float | None:
        """Return the monotonic time (s) at which the next wait ends; None if nothing waits."""
        if self.ended:
            return 0.0
        if not self.queues:
            return None
        return min(queue.first.arrival.at for queue in self.queues.values()) + self.settings.max_wait

    def untimed(self, now: float) -> list[tuple[list[LoggedCloud], bool]]:
        """Return the clouds of each sensor whose first one has times that can't be read yet, and whether it is due."""
        waiting = [queue for queue in self.queues.values() if not queue.first.timed]
        return [(queue.untimed(), now >= queue.first.arrival.at + self.settings.max_wait) for queue in waiting]

    def _judge(self, cloud: LoggedCloud, now: float) -> Proposal | None:
        if cloud.cloud.frame_id == self.settings.frame_id:
            return Proposal(cloud, INTEGRATED)
        due = now >= cloud.arrival.at + self.settings.max_wait  # the same sum as in deadline(), to the bit
        doubt, robot = self.doubts.get(cloud.input), self.robots.get(cloud.robot)
        if doubt is not None and doubt.reason is not None:
            return Proposal(cloud, doubt.reason)
        if robot is None:
            return Proposal(cloud, CloudReason.NO_POSE) if due else None
        if not cloud.timed:
            return Proposal(cloud, CloudReason.TIME_FORM) if due else None
        clock, buffer = robot.clock, robot.buffer
        if cloud.input < clock.begun:
            return Proposal(cloud, CloudReason.CLOCK_RESET)
        unmounted = self._is_unmounted(cloud, robot)
        if cloud.first_ns < buffer.horizon_ns and not clock.anew_from:
            return Proposal(cloud, CloudReason.NO_EXTRINSICS if unmounted else CloudReason.LATE)
        if not clock.doubts(cloud.input, cloud.last_ns):
            if doubt is not None and clock.taken < doubt.until_taken and not due:
                return None
            if doubt is not None and doubt.far:
                return Proposal(cloud, CloudReason.CLOCK_OFFSET)
            if buffer.covers(cloud.first_ns, cloud.last_ns):
                if unmounted:
                    return Proposal(cloud, CloudReason.NO_EXTRINSICS) if due else None
                return self._place(cloud, buffer.window(cloud.first_ns, cloud.last_ns))
        return Proposal(cloud, CloudReason.NO_POSE) if due else None

    def _is_unmounted(self, cloud: LoggedCloud, robot: Robot) -> bool:
        """Return whether it is not known yet where the cloud's sensor is mounted."""
        frame_id = cloud.cloud.frame_id
        return self.settings.by_transform(cloud.robot, frame_id) and robot.mounting(frame_id) is None

    def _place(self, cloud: LoggedCloud, poses: Sequence[Pose]) -> Proposal:
        outcome = INTEGRATED
        if too_far_apart(poses, self.settings.max_pose_gap_ns):
            outcome = CloudReason.POSE_GAP
        elif leaps(poses):
            outcome = CloudReason.POSE_JUMP
        return Proposal(cloud, outcome, tuple((pose.input, pose.transform) for pose in poses))

    def _victim(self) -> LoggedCloud | None:
        sizes: Counter[str] = Counter()
        for (robot, _), queue in self.queues.items():
            sizes[robot] += queue.size
        rows = [
            (sizes[robot], queue.published.clouds[0])
            for (robot, _), queue in self.queues.items()
            if queue.published.clouds
        ]
        most = max((size for size, _ in rows), default=0)
        return min((cloud for size, cloud in rows if size == most), key=lambda cloud: cloud.input, default=None)

    def _end(self, cloud: LoggedCloud, reason: CloudReason) -> None:
        self._remove(cloud)
        self.ended.append(Proposal(cloud, reason))

    def _remove(self, cloud: LoggedCloud) -> None:
        queue = self.queues[cloud.sensor]
        queue.remove(cloud)
        if not queue:
            del self.queues[cloud.sensor]
        self.size -= cloud.size
