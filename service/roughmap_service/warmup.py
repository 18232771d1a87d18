"""Compiling what the first scan would otherwise wait for."""

import numpy as np

from roughmap import Limits, Noise, Scan, Trajectory
from roughmap_schemas import Config

from .settings import new_map


def warm_up(config: Config) -> None:
    """Run every kernel of the configured error model once, on a map of its own that is thrown away."""
    rough_map = new_map(config)
    points = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, -0.5]])
    line = Trajectory(
        np.array([0, 10**9]),
        np.zeros((2, 3)),
        np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)),
        np.tile(np.eye(6) * 1e-4, (2, 1, 1)),
    )
    for dtype in (np.float32, np.float64):
        for offsets in (None, np.array([0, 10**8])):
            scan = Scan(points.astype(dtype), 0, offsets_ns=offsets)
            rough_map.add_scan(scan, line, Noise(0.02), Limits())
    rough_map.add(points, np.eye(3) * 1e-4, 0)
    rough_map.region((-2.0, -2.0, 2.0, 2.0), ["mean_height", "traversability"], level=0)
    rough_map.region((-2.0, -2.0, 2.0, 2.0), ["mean_height"], level=min(1, config.map.levels - 1))
    rough_map.digest()
