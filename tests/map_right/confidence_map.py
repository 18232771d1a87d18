"""The cells of a scene as a map keeps them."""

from collections.abc import Iterator

import numpy as np
from confidence_running import State
from confidence_scene import A, Scene

from roughmap.map import RoughMap
from roughmap.tiles.state import TileState

TOGETHER = 200
"""Tiles of one map: it takes 0.4 MB for each."""


def maps(scene: Scene, model: str, surface: str) -> Iterator[tuple[int, RoughMap]]:
    """Yield maps of the scene, each of a part of it, and the first tile of each part."""
    home = np.floor(scene.points[:, 0] / (64 * A)).astype(int)
    for first in range(0, len(scene.truth), TOGETHER):
        part = (home >= first) & (home < first + TOGETHER)
        m = RoughMap(cell_size=A, error_model=model, surface=surface, threads=1)
        poses = scene.poses
        for k, rows in scene.scans():
            points = scene.points[rows][part[rows]]
            if len(points):
                m.add(
                    points, scene.covariance(k), int(poses.stamp_s[k] * 1e9), common=float(poses.variance[k]),
                    mount=poses.mount, pose_error_time=poses.time,
                )  # fmt: skip
        yield first, m


def mapped(scene: Scene, model: str, surface: str = "ground") -> State:
    """Return the cells of a scene from the records of maps."""
    parts = [cells_of(m) for _, m in maps(scene, model, surface)]
    return State(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def cells_of(m: RoughMap) -> State:
    """Return the known cells of a map, by tiles."""
    base = m._table.levels[0]
    found = []
    for n in np.lexsort((base.ty[: base.size], base.tx[: base.size])).tolist():
        state: TileState = m._table.state(int(m._table.slot[n]))
        k = np.flatnonzero(state.cells["count"])
        cells, trust = state.cells[k], state.trust[k]
        tile = np.full(len(k), base.tx[n])
        found.append((
            tile, tile * 64 + k % 64, int(base.ty[n]) * 64 + k // 64, cells["count"].astype(int),
            cells["weight"], cells["weight_sq"], cells["mean"], cells["m2"], trust["variance"].astype(float),
            trust["pose_variance"].astype(float), trust["mount_sigma"].astype(float),
        ))  # fmt: skip
    return State(*(np.concatenate(values) for values in zip(*found, strict=True)))
