"""Recorded scans for tests of the command line, in the layout that `--from` and `build` read."""

from pathlib import Path

import numpy as np

LIDAR = "[sensors.lidar]\nrange_sigma = 0.01\n"
"""The recorded scanner, as configured: at its robot's origin, as the recordings have it."""

SLOPE = 0.1
HEIGHT_M = 3.0
STAMPS_S = (100.0, 100.5, 101.0)


def plane(x: np.ndarray) -> np.ndarray:
    """The recorded ground: z of the map at x of the map."""
    return HEIGHT_M + SLOPE * x


def write_recording(file: Path) -> Path:
    """Three scans of a tilted plane, in whole millimetres, from sensors 2 m above it that look along three headings."""
    rng = np.random.default_rng(11)
    parts, poses = [], []
    for k in range(len(STAMPS_S)):
        turn = 0.7 * k
        pose = np.eye(4)
        pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        pose[:3, 3] = 0.5 * k, -0.25 * k, HEIGHT_M + 2.0
        xy = rng.uniform(-4.0, 4.0, (8000, 2))
        placed = np.column_stack((xy, plane(xy[:, 0])))
        parts.append(np.rint((placed - pose[:3, 3]) @ pose[:3, :3] * 1000).astype(np.int32))
        poses.append(pose)
    np.savez(
        file,
        points=np.concatenate(parts),
        scan_start=np.arange(4) * 8000,
        pose=np.array(poses),
        stamp_s=np.array(STAMPS_S),
    )
    return file
