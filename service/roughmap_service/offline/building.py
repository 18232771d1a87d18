"""A map from recordings: scans with poses, points in the map frame, and the messages of a robot."""

import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import NamedTuple

import numpy as np

from roughmap import AddReport, Limits, Noise, RoughMap, Scan, Trajectory
from roughmap_schemas import Config
from roughmap_schemas.kinds import RobotMessage
from roughmap_service.formats.clouds import read_cloud
from roughmap_service.formats.doubts import Doubts, without_no_data
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import CloudFileFault, Contents, PlacedPoints, Recorded, RecordedScan
from roughmap_service.offline.message_run import MessageRun
from roughmap_service.offline.unmapped import why_unmapped
from roughmap_service.run.sensor_clock import SensorClock
from roughmap_service.run.settings import Settings, new_map


class Progress(NamedTuple):
    """How far it is: the file's number and name, the share of all bytes, points so far, and points a second."""

    number: int
    name: str
    share: float
    points: int
    rate: float


Watch = Callable[[Progress, RoughMap], None]


@dataclass(frozen=True)
class Wanted:
    """What scans and messages are integrated as: the robot's name, the frame of scans, noise in m if it is given."""

    robot: str = "robot"
    sensor: str = "lidar"
    range_sigma: float | None = None


@dataclass
class Built:
    """A map from recordings, with the configuration that it has now, and what became of its points and messages.

    `clouds`, `poses` and `refused` count messages by outcome; they are empty without any. `interrupted`: it ended
    before all was read.
    """

    map: RoughMap
    config: Config
    points: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    clouds: Counter[str] = field(default_factory=Counter)
    poses: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    warnings: list[str] = field(default_factory=list)
    interrupted: bool = False

    @property
    def accepted(self) -> int:
        """The number of points in the map."""
        return self.points - sum(self.rejected.values())


def build_map(
    files: Sequence[Path], config: Config, options: ReadOptions, wanted: Wanted, watch: Watch, stop: threading.Event
) -> Built:
    """Integrate recordings in their order, until `stop` is set between two parts.

    Raises CloudFileFault for what can't be read and for scans of a sensor without noise, and OSError.
    """
    return _Building(files, config, options, wanted, watch, stop).run()


class _Building:
    def __init__(
        self,
        files: Sequence[Path],
        config: Config,
        options: ReadOptions,
        wanted: Wanted,
        watch: Watch,
        stop: threading.Event,
    ) -> None:
        self._files = files
        self._wanted = wanted
        self._watch = watch
        self._stop = stop
        self._settings = Settings(config)
        self._clock = SensorClock()
        self._sizes = [max(_size(file), 1) for file in files]
        self._begun = time.monotonic()
        self._share = 0.0
        self.built = Built(new_map(config), config)
        self._messages = MessageRun(self.built.map, config, wanted.robot, wanted.range_sigma)
        self._options = replace(
            options, reached=self._reached, left_out=self._left_out, note=self.built.warnings.append
        )

    def run(self) -> Built:
        built = self.built
        for number, file in enumerate(self._files):
            doubts, self._share = Doubts(), 0.0
            with _closed(read_cloud(file, self._options)) as parts:
                for part in parts:
                    self._take(part, file, doubts)
                    self._tell(number, file)
                    if self._stop.is_set():
                        built.interrupted = True
                        break
            built.warnings += (f"{file}: {doubt}" for doubt in doubts.found(built.map.cell_size))
            if built.interrupted:
                break
        self._end()
        return built

    def _take(self, part: Recorded, file: Path, doubts: Doubts) -> None:
        if isinstance(part, Contents):
            self._messages.begin(part, str(file))
        elif isinstance(part, RobotMessage):
            self._messages.take(part)
        elif isinstance(part, RecordedScan):
            doubts.take(part.position[None])
            self._count(len(part.points), self._add_scan(part))
        else:
            kept = without_no_data(part)
            doubts.take(kept.points)
            missing = len(part.points) - len(kept.points)
            self.built.rejected.update({"no_data": missing} if missing else {})
            report = self._add_placed(kept) if len(kept.points) or not missing else None
            self._count(len(part.points), report)

    def _count(self, points: int, report: AddReport | None) -> None:
        self.built.points += points
        self.built.rejected.update({} if report is None else report.rejected)

    def _end(self) -> None:
        """Decide what waits, unless more would have come, and add up."""
        built, messages = self.built, self._messages
        if not built.interrupted:
            messages.end()
        counts = messages.counts
        waiting = counts.points - counts.decided
        built.points += counts.points - waiting
        built.rejected.update(counts.rejected)
        built.clouds, built.poses, built.refused = counts.clouds, counts.poses, counts.refused
        built.config = messages.config
        why = why_unmapped(counts, messages.config, self._wanted.robot, messages.sensors)
        built.warnings += [] if why is None else [why]

    def _add_placed(self, part: PlacedPoints) -> AddReport:
        covariance = self._settings.placed_covariance if part.covariance is None else part.covariance
        # How much of a point's error it shares with others is not in the file: all of it, to be safe.
        shared = np.nan_to_num(np.asarray(covariance)[..., 2, 2], nan=0.0, posinf=0.0)
        return self.built.map.add(part.points, covariance, part.stamp_ns, common=shared)

    def _add_scan(self, scan: RecordedScan) -> AddReport:
        settings = self._settings
        noise, limits = self._noise()
        # The recorded pose is the sensor's, so the sensor's place on the robot does not matter.
        trajectory = Trajectory(
            np.array([scan.stamp_ns]), scan.position[None], scan.rotation[None], settings.pose_covariance[None]
        )
        clear = settings.clears and self._clock.clears(scan.stamp_ns, settings.clear_interval_ns)
        report = self.built.map.add_scan(Scan(scan.points, scan.stamp_ns), trajectory, noise, limits, clear=clear)
        if clear and report.accepted:
            self._clock.cleared_ns = scan.stamp_ns
        return report

    def _noise(self) -> tuple[Noise, Limits]:
        wanted = self._wanted
        if wanted.range_sigma is not None:
            return Noise(wanted.range_sigma), Limits()
        configured = self._settings.sensor("", wanted.sensor)
        if configured is None:
            raise CloudFileFault(
                f"[sensors.{wanted.sensor}] is not configured: add it to the configuration, or use --range-sigma METRES"
            )
        return configured.noise, configured.limits

    def _reached(self, share: float) -> None:
        self._share = min(max(share, self._share), 1.0)

    def _left_out(self, reason: str, points: int) -> None:
        self.built.points += points
        self.built.rejected[reason] += points

    def _tell(self, number: int, file: Path) -> None:
        done = sum(self._sizes[:number]) + self._share * self._sizes[number]
        points = self.built.points + self._messages.counts.points
        rate = points / max(time.monotonic() - self._begun, 1e-3)
        self._watch(Progress(number + 1, file.name, done / sum(self._sizes), points, rate), self.built.map)


def _size(path: Path) -> int:
    files = [one for one in path.rglob("*") if one.is_file()] if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files)


@contextmanager
def _closed(parts: Iterator[Recorded]) -> Iterator[Iterator[Recorded]]:
    """Close a reader's files at the end, also when it is left before its end."""
    try:
        yield parts
    finally:
        close = getattr(parts, "close", None)  # a generator's
        if close is not None:
            close()


@contextmanager
def interrupting(stop: threading.Event) -> Iterator[None]:
    """Let the first Ctrl-C set `stop`, so that nothing is left half done; the second one interrupts at once."""

    def handle(_signal: int, _frame: FrameType | None) -> None:
        stop.set()
        signal.signal(signal.SIGINT, before)

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
