"""The recordings as sweeps: a hall from where one stands, and a tracked robot's sweep on a forest path."""

import csv
from dataclasses import dataclass
from decimal import Decimal
from itertools import pairwise
from pathlib import Path

import numpy as np
from right_maps import Sweep, still
from scipy.spatial.transform import Rotation

from roughmap import Limits, Noise, Scan

NOISE = Noise(range_sigma=0.02, beam_sigma=0.001)
"""Neither scanner's sheet came with its recording; these are usual."""

POSE_SIGMA, POSE_ANGLE = 0.01, 0.001
"""Metres and radians, of the estimated poses."""

HALL_SCANS = 14
OFFROAD_SWEEP = 1725981157_851716757

BODY = (-0.6, -0.4, -0.3, 0.6, 0.4, 0.6)
"""The tracked robot with its flippers, in the axes of its base."""

MOUNTED = np.array([[-0.704, 0.655, 0.274], [-0.682, -0.732, -0.001], [0.200, -0.187, 0.962]])
MOUNTED_AT = np.array([0.227, 0.0, 0.474])
"""The scanner in its base's axes, as its calibration says to three digits."""


@dataclass(frozen=True)
class Offroad:
    """The sweep, and where the robot's base was, (M, 2), before it and after."""

    sweep: Sweep
    before: np.ndarray
    after: np.ndarray


@dataclass(frozen=True)
class Hall:
    """``points``: of each scan, in the sensor's axes, metres. ``poses`` (14, 4, 4), ``stamps`` ns."""

    points: list[np.ndarray]
    poses: np.ndarray
    stamps: list[int]

    def sweeps(self, points: list[np.ndarray] | None = None) -> list[Sweep]:
        """All scans, or other points in their place."""
        return [self.sweep(k, own, Limits()) for k, own in enumerate(points or self.points)]

    def sweep(self, scan: int, points: np.ndarray, limits: Limits) -> Sweep:
        """One scan, of these points (sensor's axes)."""
        way = still(self.poses, self.stamps, POSE_SIGMA, POSE_ANGLE)
        return Sweep(Scan(points, self.stamps[scan]), way, NOISE, limits)

    def placed(self, scan: int) -> np.ndarray:
        """The points of a scan in the map."""
        return self.points[scan] @ self.poses[scan, :3, :3].T + self.poses[scan, :3, 3]


def hall(folder: Path) -> Hall:
    with np.load(folder / "hall_sequence.npz") as file:
        start, poses = file["scan_start"], file["pose"]
        points = [file["points"][a:b].astype(np.float64) / 1000 for a, b in pairwise(start)]
        stamps = [round(second * 1e9) for second in file["stamp_s"].tolist()]
    return Hall(points, poses, stamps)


def offroad(folder: Path) -> Offroad:
    """Points with a time of their own, and the poses of the base: the recording has those of its scanner."""
    with np.load(folder / "offroad_tradr" / "clouds" / "1725981157_851716757.npz") as file:
        cloud = file["cloud"]
    points = np.stack([cloud["x"], cloud["y"], cloud["z"]], axis=1).astype(np.float64)
    with (folder / "offroad_tradr" / "poses" / "lidar_poses.csv").open() as rows:
        table = list(csv.reader(rows))[1:]
    stamps = [int(Decimal(row[0]) * 10**9) for row in table]
    scanner = np.array([[float(value) for value in row[1:]] for row in table]).reshape(-1, 3, 4)
    mounted = Rotation.from_matrix(MOUNTED)
    base = Rotation.from_matrix(scanner[:, :, :3]) * mounted.inv()
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = base.as_matrix()
    poses[:, :3, 3] = scanner[:, :, 3] - base.apply(MOUNTED_AT)
    scan = Scan(points, OFFROAD_SWEEP, cloud["t"].astype(np.int64), MOUNTED_AT, mounted.as_quat())
    way = still(poses, stamps, POSE_SIGMA, POSE_ANGLE)
    limits = Limits(exclude=[BODY], max_pose_gap=5.0)  # poses lie up to 4 s apart
    at = stamps.index(OFFROAD_SWEEP)
    return Offroad(Sweep(scan, way, NOISE, limits), poses[: at + 1, :2, 3], poses[at:, :2, 3])
