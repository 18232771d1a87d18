"""Which cloud is decided next, and how: a pure state machine over clouds, poses and a clock that it is told."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from roughmap_schemas import Cloud, CloudReason
from roughmap_service.run.poses import Pose, PoseBuffer, too_far_apart, too_fast
from roughmap_service.run.settings import Settings

INTEGRATED = "integrated"


@dataclass(frozen=True, slots=True)
class WaitingCloud:
    """A logged cloud without a decision. ``arrival`` in monotonic seconds. A ``promised`` one was acknowledged, or
    waited over a restart: it never ends for want of room."""

    input: int
    robot: str
    cloud: Cloud
    first_ns: int
    last_ns: int
    arrival: float
    size: int
    promised: bool


@dataclass(frozen=True, slots=True)
class Decision:
    """What is to be done with a cloud: place it with these poses, or end it for a reason."""

    cloud: WaitingCloud
    outcome: str
    poses: tuple[Pose, ...] = ()


@dataclass(slots=True)
class Row:
    """Clouds in order of arrival, which leave it from its front alone."""

    clouds: deque[WaitingCloud] = field(default_factory=deque)
    rising: deque[WaitingCloud] = field(default_factory=deque)
    """Those behind which none is earlier: the first has the earliest time of all."""

    def append(self, cloud: WaitingCloud) -> None:
        """Take a cloud in."""
        self.clouds.append(cloud)
        while self.rising and self.rising[-1].first_ns > cloud.first_ns:
            self.rising.pop()
        self.rising.append(cloud)

    def popleft(self) -> None:
        """Let the first go."""
        if self.rising[0] is self.clouds.popleft():
            self.rising.popleft()


@dataclass(slots=True)
class RobotQueue:
    """One robot's clouds, by whether they were promised, with what is asked at each message at hand: there may be
    thousands. Only the first of each row ever goes: it is decided, or, if published, ended for want of room."""

    published: Row = field(default_factory=Row)
    promised: Row = field(default_factory=Row)
    size: int = 0

    def append(self, cloud: WaitingCloud) -> None:
        """Take a cloud in."""
        (self.promised if cloud.promised else self.published).append(cloud)
        self.size += cloud.size

    def remove(self, cloud: WaitingCloud) -> None:
        """Let the first cloud of its row go."""
        (self.promised if cloud.promised else self.published).popleft()
        self.size -= cloud.size

    def __len__(self) -> int:
        return len(self.published.clouds) + len(self.promised.clouds)

    @property
    def first(self) -> WaitingCloud:
        """The one that came first."""
        return min((row.clouds[0] for row in self._rows()), key=lambda cloud: cloud.input)

    @property
    def earliest_ns(self) -> int:
        """The smallest time of a point in any of them, in ns."""
        return min(row.rising[0].first_ns for row in self._rows())

    def _rows(self) -> list[Row]:
        return [row for row in (self.published, self.promised) if row.clouds]


@dataclass
class Inbox:
    """Clouds in order of arrival a robot; robots don't wait for each other.

    ``poses`` is the robots' pose buffers, which others fill. Wall time is never compared with stamps: the only clock
    is the monotonic one of `arrival` and `tick`.
    """

    settings: Settings
    poses: Mapping[str, PoseBuffer]
    queues: dict[str, RobotQueue] = field(default_factory=dict)
    ended: deque[Decision] = field(default_factory=deque)
    size: int = 0

    def has_room(self, size: int) -> bool:
        """Whether a cloud of ``size`` bytes fits without ending another; one alone does, which may hold more than its
        message has."""
        return not self.size or self.size + size <= self.settings.queue_limit

    def feed(self, cloud: WaitingCloud) -> None:
        """A cloud was logged. Past the limit the oldest published cloud of the robot that holds most ends."""
        self.queues.setdefault(cloud.robot, RobotQueue()).append(cloud)
        self.size += cloud.size
        while self.size > self.settings.queue_limit and self.size > cloud.size:
            victim = self._victim()
            if victim is None:
                return
            self._end(victim, CloudReason.OVERLOAD)

    def clock_reset(self, robot: str) -> None:
        """The robot's clock was set back: what waits for the old clock's poses waits in vain."""
        while robot in self.queues:
            self._end(self.queues[robot].first, CloudReason.CLOCK_RESET)

    def holds_before(self, robot: str, stamp_ns: int) -> bool:
        """Whether a cloud of the robot waits that has a point before that time."""
        return robot in self.queues and self.queues[robot].earliest_ns < stamp_ns

    def tick(self, now: float) -> Decision | None:
        """The next decision at monotonic time ``now``, or None. Robots take turns, so that none waits behind all that
        another one sent."""
        if self.ended:
            return self.ended.popleft()
        for robot, queue in self.queues.items():
            decision = self._judge(queue.first, now)
            if decision is not None:
                self.queues[robot] = self.queues.pop(robot)  # behind the others
                self._remove(decision.cloud)
                return decision
        return None

    def deadline(self) -> float | None:
        """The monotonic time at which the next wait ends; None when nothing waits."""
        if self.ended:
            return 0.0
        if not self.queues:
            return None
        return min(queue.first.arrival for queue in self.queues.values()) + self.settings.max_wait

    def oldest_input(self) -> int | None:
        """The smallest input number without a decision: the low-water position."""
        waiting = [queue.first.input for queue in self.queues.values()]
        waiting += [decision.cloud.input for decision in self.ended]
        return min(waiting, default=None)

    def _judge(self, cloud: WaitingCloud, now: float) -> Decision | None:
        if cloud.cloud.frame_id == self.settings.frame_id:
            return Decision(cloud, INTEGRATED)
        buffer = self.poses.get(cloud.robot)
        if buffer is not None:
            if cloud.first_ns < buffer.horizon_ns:
                return Decision(cloud, CloudReason.LATE)
            if buffer.covers(cloud.first_ns, cloud.last_ns):
                poses = tuple(buffer.window(cloud.first_ns, cloud.last_ns))
                if too_far_apart(poses, self.settings.max_pose_gap_ns):
                    return Decision(cloud, CloudReason.POSE_GAP, poses)
                if too_fast(poses, self.settings.max_speed, self.settings.max_turn):
                    return Decision(cloud, CloudReason.POSE_JUMP, poses)
                return Decision(cloud, INTEGRATED, poses)
        if now >= cloud.arrival + self.settings.max_wait:  # the same sum as in deadline(), so that then it is due
            return Decision(cloud, CloudReason.NO_POSE)
        return None

    def _victim(self) -> WaitingCloud | None:
        queues = [queue for queue in self.queues.values() if queue.published.clouds]
        return max(queues, key=lambda queue: queue.size).published.clouds[0] if queues else None

    def _end(self, cloud: WaitingCloud, reason: CloudReason) -> None:
        self._remove(cloud)
        self.ended.append(Decision(cloud, reason))

    def _remove(self, cloud: WaitingCloud) -> None:
        queue = self.queues[cloud.robot]
        queue.remove(cloud)
        if not queue:
            del self.queues[cloud.robot]
        self.size -= cloud.size
