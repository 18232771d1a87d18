"""The rows by which versions are compared, and what they are held to."""

from dataclasses import dataclass

from figures import Mark


@dataclass(frozen=True)
class Spec:
    """One row, measured by the job that its key begins with. ``more``: more of it is better."""

    key: str
    figure: str
    unit: str
    more: bool = False
    mark: Mark | None = None
    """For the new version's own value; marks against an old version are in ``GOALS``."""

    @property
    def job(self) -> str:
        """A process of each version measures all rows of a job."""
        return self.key.partition(".")[0]


def most(bound: float) -> Mark:
    """The new version's value is at most that."""
    return Mark(bound)


def least(bound: float) -> Mark:
    """The new version's value is at least that."""
    return Mark(bound, least=True)


SPECS = (
    Spec("kernel.new", "add_scan, cuboid, new ground", "ns a point"),
    Spec("kernel.known", "add_scan, cuboid, known ground", "ns a point"),
    Spec("kernel.deskew", "the same with a time for each point, 10 poses a sweep, new ground", "ns a point"),
    Spec("kernel.deskew.cost", "time with such times against one pose a scan", "x", mark=most(1.3)),
    Spec("kernel.scattered", "points and their times in no order, new ground", "ns a point"),
    Spec("kernel.point", "add_scan, point, new ground", "ns a point"),
    Spec("kernel.ellipsoid", "add_scan, ellipsoid, new ground", "ns a point"),
    Spec("kernel.hall", "add_scan, cuboid, a recorded hall, new ground", "ns a point"),
    Spec("kernel.offroad", "add_scan, cuboid, a recorded forest path, a time for each point", "ns a point"),
    Spec("kernel.broken", "add, cuboid, a recorded survey of broken ground", "ns a point"),
    Spec("threads.new", "add_scan, cuboid, two threads, new ground", "ns a point"),
    Spec("threads.new.gain", "speed-up of two threads over one, new ground", "x", True, least(1.7)),
    Spec("threads.known", "add_scan, cuboid, two threads, known ground", "ns a point"),
    Spec("threads.known.gain", "speed-up of two threads over one, known ground", "x", True, least(1.7)),
    Spec("memory.dense", "resident memory, dense map", "bytes a known cell", mark=most(70.0)),
    Spec("memory.drive", "resident memory, the benchmark's drive", "bytes a known cell", mark=most(200.0)),
    Spec("service.tcp", "service, log on, TCP", "M points/s", True),
    Spec("service.tcp.share", "service by TCP over library, one thread each", "x", True, least(0.75)),
    Spec("service.shm", "service, log on, shared memory", "M points/s", True),
    Spec("service.shm.share", "service by shared memory over library, one thread each", "x", True, least(0.6)),
    Spec("service.replay", "replay of that log", "x real time", True, least(10.0)),
    Spec("region.tcp", "region of 400 tiles, 2 layers, TCP", "MB/s", True),
    Spec("region.tcp.share", "region by TCP over an echo of its bytes", "x", True, least(0.7)),
    Spec("region.shm", "region of 400 tiles, 2 layers, shared memory", "MB/s", True),
    Spec("region.shm.share", "region by shared memory over an echo of its bytes", "x", True, least(0.7)),
    Spec("robot.cpu", "CPU of the service, 10 Hz, 131k points, 20 queries a second", "ms a scan"),
    Spec("robot.cpu.beside", "CPU of the service beside the library's for these scans", "ms a scan"),
    Spec("robot.p50", "scan to queryable meanwhile, p50", "ms"),
    Spec("robot.p99", "scan to queryable meanwhile, p99", "ms", mark=most(60.0)),
    Spec("robot.planner.p50", "a planner's 20 x 20 m, 2 layers, meanwhile, p50", "ms"),
    Spec("robot.planner.p99", "a planner's 20 x 20 m, 2 layers, meanwhile, p99", "ms", mark=most(15.0)),
)

PAIRS = {"kernel": 15, "threads": 15, "memory": 3, "service": 7, "region": 7, "robot": 5}
"""Pairs of processes by job: seconds each of the first, up to a minute each of the last."""

GOALS: dict[str, dict[str, Mark]] = {
    "215a334": {
        "kernel.new": Mark(0.85, "ratio"),
        "kernel.known": Mark(0.85, "ratio"),
        "kernel.scattered": Mark(0.55, "ratio"),
        "kernel.point": Mark(0.92, "ratio"),
        "kernel.ellipsoid": Mark(0.95, "ratio"),
        "robot.cpu.beside": Mark(0.67, "ratio"),
        "robot.p99": Mark(1.0, "ratio"),
    },
    "e2205a3": {  # before maps of the ground
        "kernel.new": Mark(1.15, "ratio"),
        "kernel.known": Mark(1.15, "ratio"),
        "kernel.hall": Mark(1.4, "ratio"),
        "kernel.offroad": Mark(1.4, "ratio"),
        "kernel.broken": Mark(1.5, "ratio"),
    },
}
"""What was aimed at against some old version: marks for new / old, in place of those for the value."""


def mark(spec: Spec, commit: str) -> Mark | None:
    """What a row is held to when ``commit`` is the old version."""
    for start, goals in GOALS.items():
        if commit.startswith(start) and spec.key in goals:
            return goals[spec.key]
    return spec.mark


def chosen(only: list[str]) -> list[Spec]:
    """The rows of these keys or beginnings of keys, such as a job; all, if none is named."""
    return [spec for spec in SPECS if not only or any(f"{spec.key}.".startswith(f"{name}.") for name in only)]
