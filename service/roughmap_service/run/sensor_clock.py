"""Whether the stamps of a sensor's clouds can be believed: by the clouds before, and by the robot's odometry."""

from dataclasses import asdict, dataclass, field
from typing import Any

from roughmap_schemas import CloudReason
from roughmap_service.run.odometry_clock import OdometryClock

LIMIT_NS = 500_000_000
"""A sensor whose clock differs by more than this from the robot's is refused."""

NOTICE_NS = 200_000_000
"""A sensor's clock that moved by more than this against the robot's is reported."""

ROW = 2
"""Clouds in a row that fell back, after which the sensor's clock did."""

LEAP_ROW = 3
"""Clouds in a row that must be far ahead before their stamps count."""

STILL = 3
"""Clouds in a row with one stamp, while poses go on, after which the sensor's clock stands still."""

LONG_ROW = 10
"""The same where no odometry comes."""

POSES = 3
"""Poses taken after a cloud fell back, after which the robot's clock did not go back with it."""

WINDOW_NS = 2_000_000_000
LONGEST_WINDOW_NS = 5_000_000_000
"""Time over which arrivals and stamps are compared."""

RATIO = 0.15
"""How far the stamps' advance over a window may differ from the arrivals', as a part of it: a recording that is played
at another speed says nothing about clocks."""

SETTLED = 10
"""Clouds integrated before the difference of the clocks is taken as the usual one."""


@dataclass(frozen=True, slots=True)
class Doubt:
    """Why a cloud's stamp is in doubt.

    ``reason``: the cloud ends as this. Without one, it waits until the robot has taken ``until_taken`` poses of its
    present clock, or `input.max_wait` is over; then one that fell back ``far`` ends as `clock_offset`, and others are
    decided as usual.
    """

    reason: CloudReason | None = None
    until_taken: int = 0
    far: bool = False

    def to_state(self) -> list[Any]:
        """Return it as JSON values."""
        return [self.reason, self.until_taken, self.far]

    @classmethod
    def of_state(cls, state: list[Any]) -> "Doubt":
        """Restore what `to_state` returned."""
        reason, until_taken, far = state
        return cls(None if reason is None else CloudReason(reason), until_taken, far)


@dataclass
class Window:
    """Arrivals and stamps of a sensor's clouds and of its robot's odometry over some 2 s."""

    arrival_ns: int = -1
    cloud_ns: int = 0
    cloud_least_ns: int = 0
    odometry_ns: int = -1
    odometry_last_ns: int = 0
    odometry_least_ns: int = 0


@dataclass
class SensorClock:
    """The state of one sensor's stamps.

    Attributes:
        last_ns: stamp of the last cloud, and its arrival.
        confirmed_ns: the newest stamp that a later cloud did not fall behind, and its arrival.
        fell: input number of the last cloud that fell behind its predecessor.
        fenced: since the robot's clock went back, no cloud fell back: they may be of the clock before.
        leapt: clouds in a row that are more than `LIMIT_NS` ahead of ``confirmed_ns``.
        row: clouds in a row that are more than `NOTICE_NS` behind ``confirmed_ns``; ``row_taken``: poses taken then.
        same: clouds in a row with the stamp of the one before; ``same_newest_ns``: the newest pose at the first.
        offset_ns: by how much the clock is ahead of the robot's, as far as known; 0 if it agrees.
        late_ns: by how much its clouds come later than usual: a longer way, or a clock that is behind.
        usual_ns: the usual latency of its clouds, less that of the odometry; None until known.
        ahead: windows in a row in which the clock was ahead.
        integrated: clouds integrated, up to `SETTLED`.
        cleared_ns: stamp of the last scan that cleared; -1: none.
    """

    last_ns: int = -1
    last_arrival_ns: int = 0
    confirmed_ns: int = -1
    confirmed_arrival_ns: int = 0
    fell: int = 0
    fenced: bool = False
    leapt: int = 0
    row: int = 0
    row_taken: int = 0
    same: int = 0
    same_newest_ns: int = -1
    offset_ns: int = 0
    late_ns: int = 0
    usual_ns: int | None = None
    ahead: int = 0
    integrated: int = 0
    cleared_ns: int = -1
    window: Window = field(default_factory=Window)

    @property
    def differs(self) -> bool:
        """Whether the sensor's clouds are refused for its clock."""
        return abs(self.offset_ns) > LIMIT_NS

    def cloud(self, number: int, stamp_ns: int, arrival_ns: int, clock: OdometryClock) -> Doubt | None:
        """Take the next cloud: its input number, stamp and arrival. Return the doubt in it, None if there is none."""
        last, self.last_ns = self.last_ns, stamp_ns
        last_arrival, self.last_arrival_ns = self.last_arrival_ns, arrival_ns
        fell = stamp_ns < last
        if fell:
            self.fell = number
        if self.fenced:
            if not fell and clock.newest_ns < clock.fence_ns:
                return Doubt(CloudReason.CLOCK_RESET)
            self.begin()
            return None
        self._measure(stamp_ns, arrival_ns)
        if self._stands_still(stamp_ns, last, clock):
            return Doubt(CloudReason.CLOCK_OFFSET)
        far = 0 <= self.confirmed_ns < stamp_ns - LIMIT_NS  # a wild stamp, or the clock leapt forward
        self.leapt = 0 if not far else 1 if fell else self.leapt + 1
        if not fell and last > self.confirmed_ns and (not far or self.leapt >= LEAP_ROW):
            self.confirmed_ns, self.confirmed_arrival_ns = last, last_arrival
        behind = 0
        if stamp_ns < self.confirmed_ns:
            behind = self.confirmed_ns - stamp_ns + max(arrival_ns - self.confirmed_arrival_ns, 0)
        if behind <= NOTICE_NS:
            self.row = 0
        else:
            self._fall_back(behind, clock)
        if self.differs:
            return Doubt(CloudReason.CLOCK_OFFSET)
        if fell or behind > LIMIT_NS:
            return Doubt(None, clock.taken + POSES, behind > LIMIT_NS)
        return None

    def odometry(self, stamp_ns: int, arrival_ns: int) -> None:
        """Take an odometry of its robot that is believed."""
        window = self.window
        if window.arrival_ns < 0:
            return
        latency = arrival_ns - stamp_ns
        if window.odometry_ns < 0:
            window.odometry_ns, window.odometry_least_ns = stamp_ns, latency
        window.odometry_last_ns = stamp_ns
        window.odometry_least_ns = min(window.odometry_least_ns, latency)

    def clears(self, stamp_ns: int, interval_ns: int) -> bool:
        """Return whether a scan of this stamp clears what it sees through: one does in each interval."""
        return self.cleared_ns < 0 or not 0 <= stamp_ns - self.cleared_ns < interval_ns

    def count_integrated(self) -> None:
        """Count a cloud that went into the map."""
        self.integrated = min(self.integrated + 1, SETTLED)

    def begin(self) -> None:
        """Begin anew: the robot's clock went back, and the sensor's with it, or the map was emptied."""
        self.confirmed_ns = -1
        self.fenced = False
        self.leapt = self.row = self.same = self.offset_ns = self.late_ns = self.ahead = self.integrated = 0
        self.usual_ns = None
        self.window = Window()

    def _stands_still(self, stamp_ns: int, last: int, clock: OdometryClock) -> bool:
        if stamp_ns != last:
            self.same, self.same_newest_ns = 0, clock.newest_ns
            return False
        self.same += 1
        return self.same + 1 >= STILL and clock.newest_ns - self.same_newest_ns > NOTICE_NS

    def _fall_back(self, behind: int, clock: OdometryClock) -> None:
        """Count a cloud far behind the newest. Enough of them show that the sensor's clock went back alone."""
        if not self.row:
            self.row_taken = clock.taken
        self.row += 1
        alone = not clock.doubted and clock.taken - self.row_taken >= POSES
        if (self.row >= ROW and alone) or self.row >= LONG_ROW:
            self.offset_ns = self.offset_ns or -behind

    def _measure(self, stamp_ns: int, arrival_ns: int) -> None:
        """Compare the latencies of clouds and odometry over windows of 2 s: a sensor's clock that leaps ahead makes its
        clouds come sooner than the odometry. A later one would be a longer way, so it is no sign."""
        window, latency = self.window, arrival_ns - stamp_ns
        if window.arrival_ns >= 0:
            window.cloud_least_ns = min(window.cloud_least_ns, latency)
            took = arrival_ns - window.arrival_ns
            if took < WINDOW_NS:
                return
            if took <= LONGEST_WINDOW_NS and window.odometry_ns >= 0:
                advanced = stamp_ns - window.cloud_ns, window.odometry_last_ns - window.odometry_ns
                if all(abs(way - took) <= RATIO * took for way in advanced):
                    self._compare(window.cloud_least_ns - window.odometry_least_ns)
        self.window = Window(arrival_ns, stamp_ns, latency)

    def _compare(self, later_ns: int) -> None:
        """Take by how much more time clouds took than odometry in the last window."""
        if self.usual_ns is None:
            if self.integrated >= SETTLED:
                self.usual_ns = later_ns
            elif self.offset_ns and -NOTICE_NS <= later_ns <= LIMIT_NS:
                self._agree()  # it fell back from a wrong time to the right one
            return
        sooner = self.usual_ns - later_ns
        self.late_ns = -sooner if sooner < -NOTICE_NS else 0
        if abs(sooner) <= NOTICE_NS:
            self._agree()
        elif sooner > 0:
            self.ahead += 1
            # Clouds that queued on their way come sooner once the queue is empty, but never before the odometry.
            if self.ahead >= 2 and (sooner <= LIMIT_NS or later_ns < 0):
                self.offset_ns = sooner
        else:
            self.ahead = 0

    def _agree(self) -> None:
        """The clock agrees with the robot's: stamps from when it did not are forgotten."""
        if self.offset_ns:
            self.confirmed_ns, self.leapt = -1, 0
        self.offset_ns = self.ahead = self.row = 0

    def to_state(self) -> dict[str, Any]:
        """Return everything as JSON values."""
        return asdict(self)

    @classmethod
    def of_state(cls, state: dict[str, Any]) -> "SensorClock":
        """Restore what `to_state` returned."""
        return cls(**{**state, "window": Window(**state["window"])})
