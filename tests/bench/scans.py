"""The benchmark's scans: a spinning scanner 1.2 m over wavy ground, made once and kept in a file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from roughmap import Noise, Scan, Trajectory

F8 = npt.NDArray[np.float64]
I8 = npt.NDArray[np.int64]

SCANS, RINGS, COLUMNS = 30, 64, 1024
HEIGHT_M, STEP_M, REACH_M = 1.2, 0.3, 30.0
START_NS = 1_700_000_000_000_000_000
SWEEP_NS = 100_000_000
POSES_A_SWEEP = 10

CELL_SIZE = 0.1
COVERAGE, MIN_RADIUS, MIN_SHARE, MIN_DISTANCE, WIDEST = 2.0, 1e-3, 0.05, 1e-3, 0.5
NOISE = Noise(range_sigma=0.02, beam_sigma=0.001)
POSE_VARIANCE = np.diag(np.square([0.01, 0.01, 0.01, 0.002, 0.002, 0.003]))

_STEEPEST = np.hypot(0.5 * 0.30 + 1.7 * 0.12, 0.35 * 0.30 + 2.3 * 0.08)
"""No slope of the ground is greater: a ray may go on by its height over it, divided by how fast that can shrink."""


def ground(x: F8, y: F8) -> F8:
    """Its height, metres."""
    return 0.30 * np.sin(0.50 * x) * np.cos(0.35 * y) + 0.12 * np.sin(1.7 * x + 0.6) + 0.08 * np.sin(2.3 * y)


@dataclass(frozen=True)
class Recording:
    """Scans one after the other. ``points``: (N, 3) float32 each, sensor frame, ring after ring; ``columns`` (N,): the
    column of the sweep in which each point was taken, of ``across``; ``position`` (K, 3): the sensor's, never turned.
    """

    points: list[npt.NDArray[np.float32]]
    columns: list[I8]
    position: F8
    across: int

    def offsets_ns(self, k: int) -> I8:
        """Each point's time after its scan's stamp."""
        return self.columns[k] * (SWEEP_NS // self.across)


def recorded(folder: Path, scans: int = SCANS, across: int = COLUMNS) -> Recording:
    """The first scans of the drive, made or read from ``folder``; the same every time."""
    path = folder / f"scans-{scans}-{across}.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        made = [_scan(k, across) for k in range(scans)]
        np.savez(
            path,
            points=np.concatenate([p for p, _ in made]),
            columns=np.concatenate([c for _, c in made]),
            ends=np.cumsum([len(p) for p, _ in made]),
        )
    with np.load(path) as data:
        cuts = data["ends"][:-1]
        points, columns = np.split(data["points"], cuts), np.split(data["columns"], cuts)
    return Recording(points, columns, np.array([_sensor(k) for k in range(scans)]), across)


def _sensor(k: int) -> F8:
    x = np.float64(-4.35 + STEP_M * k)
    return np.array([x, 0.0, ground(x, np.float64(0.0)) + HEIGHT_M])


def _scan(k: int, across: int) -> tuple[npt.NDArray[np.float32], I8]:
    rng = np.random.default_rng([7, k])
    elevation, turn = np.meshgrid(
        np.deg2rad(np.linspace(-45.0, -2.5, RINGS)),
        np.linspace(-np.pi, np.pi, across, endpoint=False),
        indexing="ij",
    )
    flat = np.cos(elevation)
    ray = np.stack([flat * np.cos(turn), flat * np.sin(turn), np.sin(elevation)], axis=-1).reshape(-1, 3)
    distance = _strike(_sensor(k), ray)
    seen = distance <= REACH_M
    distance += rng.normal(0.0, 0.02, len(distance))
    points = ray * distance[:, None]
    points[:, 2] += rng.normal(0.0, 0.03, len(points))
    column = np.tile(np.arange(across), RINGS)
    return points[seen].astype(np.float32), column[seen]


def _strike(sensor: F8, ray: F8) -> F8:
    """How far each ray goes to within a millimetre of the ground; beyond the reach where it doesn't meet it."""
    distance = np.zeros(len(ray))
    shrink = _STEEPEST * np.hypot(ray[:, 0], ray[:, 1]) - ray[:, 2]
    under_way = np.arange(len(ray))
    while under_way.size:
        p = sensor + ray[under_way] * distance[under_way, None]
        over = p[:, 2] - ground(p[:, 0], p[:, 1])
        distance[under_way] += over / shrink[under_way]
        under_way = under_way[(over > 1e-3) & (distance[under_way] <= REACH_M)]
    return distance


@dataclass(frozen=True)
class Drive:
    """Scans and the way along which they were taken."""

    scans: list[Scan]
    way: Trajectory

    @property
    def points(self) -> int:
        """Of all scans."""
        return sum(len(scan.points) for scan in self.scans)


def still(recording: Recording, shift: tuple[float, float] = (0.0, 0.0)) -> Drive:
    """Every scan placed with the one pose at its stamp, ring after ring; the whole drive moved by ``shift`` metres."""
    stamps = _stamps(len(recording.points))
    scans = [Scan(p, int(t)) for p, t in zip(recording.points, stamps, strict=True)]
    return Drive(scans, _way(stamps, recording.position + np.array([*shift, 0.0])))


def moving(recording: Recording, order: str) -> Drive:
    """Every point placed at its own time between ten poses a sweep; in the ``order`` "rows" (ring after ring),
    "columns" (as a spinning scanner sends them) or "scattered"."""
    number = len(recording.points)
    # One sweep more, so that the last has a pose after it.
    fine = np.arange((number + 1) * POSES_A_SWEEP + 1) / POSES_A_SWEEP
    position = np.stack([np.interp(fine, np.arange(number), recording.position[:, n]) for n in range(3)], axis=1)
    way = _way(START_NS + SWEEP_NS // POSES_A_SWEEP * np.arange(len(fine)), position)
    scans = []
    for k, stamp in enumerate(_stamps(number)):
        points, offsets = recording.points[k], recording.offsets_ns(k)
        if order == "columns":
            chosen = np.argsort(recording.columns[k], kind="stable")
        elif order == "scattered":
            chosen = np.random.default_rng(k).permutation(len(points))
        else:
            chosen = np.arange(len(points))
        scans.append(Scan(np.ascontiguousarray(points[chosen]), int(stamp), offsets[chosen]))
    return Drive(scans, way)


def scattered(recording: Recording) -> Drive:
    """As `still`, the points of each scan in no order."""
    drive = still(recording)
    mixed = [np.random.default_rng(k).permutation(scan.points) for k, scan in enumerate(drive.scans)]
    return Drive([Scan(p, scan.stamp_ns) for p, scan in zip(mixed, drive.scans, strict=True)], drive.way)


def wide(scans: int) -> Drive:
    """Every scan 64 rings of ground 30 to 60 m away: what the pose's turn is unsure of lies over many cells there."""
    position = np.array([_sensor(k) for k in range(scans)])
    away, turn = np.meshgrid(
        np.linspace(30.0, 60.0, RINGS), np.linspace(-np.pi, np.pi, COLUMNS, endpoint=False), indexing="ij"
    )
    made = []
    for k, (sensor, stamp) in enumerate(zip(position, _stamps(scans), strict=True)):
        x, y = (away * np.cos(turn)).ravel(), (away * np.sin(turn)).ravel()
        z = ground(x + sensor[0], y) - sensor[2] + np.random.default_rng(k).normal(0.0, 0.04, len(x))
        made.append(Scan(np.stack([x, y, z], axis=1).astype(np.float32), int(stamp)))
    return Drive(made, _way(_stamps(scans), position))


def within(recording: Recording, half_x: float, half_y: float) -> Recording:
    """Of each scan the points in a box around the middle of the drive."""
    middle = recording.position.mean(axis=0)
    kept = [
        (np.abs(p[:, 0] + at[0] - middle[0]) < half_x) & (np.abs(p[:, 1] + at[1] - middle[1]) < half_y)
        for p, at in zip(recording.points, recording.position, strict=True)
    ]
    points = [p[k] for p, k in zip(recording.points, kept, strict=True)]
    columns = [c[k] for c, k in zip(recording.columns, kept, strict=True)]
    return Recording(points, columns, recording.position - middle * np.array([1.0, 1.0, 0.0]), recording.across)


def _stamps(number: int) -> I8:
    return START_NS + SWEEP_NS * np.arange(number)


def _way(stamps: I8, position: F8) -> Trajectory:
    number = len(stamps)
    return Trajectory(
        stamps, position, np.tile([0.0, 0.0, 0.0, 1.0], (number, 1)), np.tile(POSE_VARIANCE, (number, 1, 1))
    )
