"""Recorded points for the comparison of versions: a hall, a forest path, a survey of broken ground.

The folder holds hall_sequence.npz, offroad_tradr/ and lone-star.laz (CONTRIBUTING.md).
"""

import csv
from decimal import Decimal
from itertools import pairwise
from pathlib import Path

import numpy as np
from scans import CELL_SIZE, F8, POSE_VARIANCE, Drive
from scipy.spatial.transform import Rotation

from roughmap import RoughMap, Scan, Trajectory

OFFROAD_SWEEP = "1725981157_851716757"
AGAIN = 4
"""There is one sweep of the forest path: it comes so many times."""

SURVEY_COVARIANCE = np.array([[4.0, 1.0, 1.0], [1.0, 9.0, -1.0], [1.0, -1.0, 4.0]]) * 1e-4
SURVEY_CALL = 1 << 16
"""Points of the survey that are added together."""


def hall(folder: Path) -> Drive:
    """14 scans, each placed with one pose."""
    with np.load(folder / "hall_sequence.npz") as file:
        stamps = np.round(file["stamp_s"] * 1e9).astype(np.int64)
        pose, points = file["pose"], (file["points"] / 1000).astype(np.float32)
        cuts = list(pairwise(file["scan_start"].tolist()))
    scans = [Scan(points[a:b], int(stamp)) for (a, b), stamp in zip(cuts, stamps, strict=True)]
    return Drive(scans, _way(stamps, pose[:, :3]))


def offroad(folder: Path) -> Drive:
    """One sweep, a time for each point, several times over."""
    with np.load(folder / "offroad_tradr" / "clouds" / f"{OFFROAD_SWEEP}.npz") as file:
        cloud = file["cloud"].reshape(-1)
    points = np.stack([cloud[axis] for axis in "xyz"], axis=1).astype(np.float32)
    with (folder / "offroad_tradr" / "poses" / "lidar_poses.csv").open() as text:
        rows = list(csv.reader(text))[1:]
    stamps = np.array([int(Decimal(row[0]) * 10**9) for row in rows])
    pose = np.array([[float(value) for value in row[1:]] for row in rows]).reshape(-1, 3, 4)
    scan = Scan(points, int(OFFROAD_SWEEP.replace("_", "")), cloud["t"].astype(np.int64))
    return Drive([scan] * AGAIN, _way(stamps, pose))


def _way(stamps: np.ndarray, pose: F8) -> Trajectory:
    turn = Rotation.from_matrix(pose[:, :, :3]).as_quat()
    return Trajectory(stamps, pose[:, :, 3], turn, np.tile(POSE_VARIANCE, (len(stamps), 1, 1)))


def survey(folder: Path) -> F8:
    """Points in UTM coordinates."""
    import laspy

    return np.ascontiguousarray(laspy.read(folder / "lone-star.laz").xyz)


def surveyed(points: F8) -> RoughMap:
    """The survey's map."""
    built = RoughMap(CELL_SIZE, "cuboid", threads=1)
    for start in range(0, len(points), SURVEY_CALL):
        built.add(points[start : start + SURVEY_CALL], SURVEY_COVARIANCE, start * 10**6)
    return built
