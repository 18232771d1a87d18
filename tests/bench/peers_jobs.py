"""Each peer doing its best at what comes nearest to a map of cells: count, mean, standard deviation, least, largest."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scans import CELL_SIZE

F8 = npt.NDArray[np.float64]

BINS = 1e-3
"""They cut a box into bins by another rounding of its edges than floor(x / a)."""

BATCH = "error footprints, confidence, placing; a new scan means all points anew"


@dataclass(frozen=True)
class Points:
    """Points in the map's frame, scan by scan, and where the sensor was."""

    scans: list[F8]
    sensor: list[F8]

    @property
    def number(self) -> int:
        """Of all scans."""
        return sum(map(len, self.scans))

    def first(self, scans: int) -> "Points":
        """Those of the first scans."""
        return Points(self.scans[:scans], self.sensor[:scans])

    def planes(self) -> tuple[F8, F8, F8]:
        """x, y, z of all points."""
        x, y, z = np.ascontiguousarray(np.concatenate(self.scans).T)
        return x, y, z


@dataclass(frozen=True)
class Job:
    """``prepare(points)`` gives what is timed; that returns its number of cells.

    ``differs``: by how much, relative, these may differ from ours; None where a cell is something else. ``scans``: only
    so many scans, where more would take minutes; 0: all.
    """

    package: str
    what: str
    prepare: Callable[[Points], Callable[[], int]]
    leaves_out: str
    differs: float | None = 0.0
    scans: int = 0


def _numpy(points: Points) -> Callable[[], int]:
    x, y, z = points.planes()

    def run() -> int:
        key = (np.floor(x / CELL_SIZE).astype(np.int64) << 32) + np.floor(y / CELL_SIZE).astype(np.int64)
        order = np.argsort(key, kind="stable")
        begin = np.flatnonzero(np.diff(key[order], prepend=key[order[0]] - 1))
        h = z[order]
        count = np.diff(begin, append=len(h))
        mean = np.add.reduceat(h, begin) / count
        np.sqrt(np.add.reduceat((h - np.repeat(mean, count)) ** 2, begin) / np.maximum(count - 1, 1))
        np.minimum.reduceat(h, begin)
        np.maximum.reduceat(h, begin)
        return len(begin)

    return run


def _pandas(points: Points) -> Callable[[], int]:
    import pandas as pd

    x, y, z = points.planes()

    def run() -> int:
        key = (np.floor(x / CELL_SIZE).astype(np.int64) << 32) + np.floor(y / CELL_SIZE).astype(np.int64)
        frame = pd.DataFrame({"key": key, "z": z})
        return len(frame.groupby("key", sort=False)["z"].agg(["count", "mean", "std", "min", "max"]))

    return run


def _polars(points: Points) -> Callable[[], int]:
    import polars as pl

    x, y, z = points.planes()
    frame = pl.DataFrame({"x": x, "y": y, "z": z})
    cell = [(pl.col(name) / CELL_SIZE).floor().cast(pl.Int64) for name in "xy"]
    h = pl.col("z")
    wanted = [
        pl.len().alias("count"),
        h.mean().alias("mean"),
        h.std().alias("std"),
        h.min().alias("min"),
        h.max().alias("max"),
    ]

    def run() -> int:
        keyed = frame.lazy().select((cell[0] * 2**32 + cell[1]).alias("key"), h)
        return keyed.group_by("key").agg(wanted).collect().height

    return run


def _edges(values: F8) -> F8:
    low, high = np.floor(values.min() / CELL_SIZE), np.floor(values.max() / CELL_SIZE) + 1
    return np.arange(low, high + 1) * CELL_SIZE


def _scipy(points: Points) -> Callable[[], int]:
    from scipy.stats import binned_statistic_dd

    x, y, z = points.planes()
    bins = [_edges(x), _edges(y)]
    place = np.stack([x, y], axis=1)

    def run() -> int:
        first = binned_statistic_dd(place, z, "count", bins)
        for statistic in ("mean", "std", "min", "max"):
            binned_statistic_dd(place, z, statistic, binned_statistic_result=first)
        return int((first.statistic > 0).sum())

    return run


def _datashader(points: Points) -> Callable[[], int]:
    import datashader as ds
    import pandas as pd

    x, y, z = points.planes()
    across, along = _edges(x), _edges(y)
    frame = pd.DataFrame({"x": x, "y": y, "z": z})
    canvas = ds.Canvas(len(across) - 1, len(along) - 1, (across[0], across[-1]), (along[0], along[-1]))
    wanted = ds.summary(count=ds.count("z"), mean=ds.mean("z"), std=ds.std("z"), min=ds.min("z"), max=ds.max("z"))

    def run() -> int:
        made = canvas.points(frame, "x", "y", agg=wanted)
        return int((made["count"].to_numpy() > 0).sum())

    return run


def _octomap(package: str) -> Callable[[Points], Callable[[], int]]:
    def prepare(points: Points) -> Callable[[], int]:
        module = __import__(package)

        def run() -> int:
            tree = module.OcTree(CELL_SIZE)
            for scan, sensor in zip(points.scans, points.sensor, strict=True):
                tree.insertPointCloud(scan, sensor, lazy_eval=True, discretize=True)
            tree.updateInnerOccupancy()
            return int(tree.size())

        return run

    return prepare


TREE = (
    "heights with their spread, footprints, confidence; but it carves free space along every ray, which we don't; "
    "two scans only"
)

JOBS = (
    Job("numpy", "sort and reduceat", _numpy, BATCH),
    Job("pandas", "groupby.agg", _pandas, BATCH),
    Job("polars", "group_by.agg, one thread", _polars, BATCH),
    Job("scipy", "binned_statistic_dd", _scipy, f"{BATCH}; only a box known before", differs=BINS),
    Job("datashader", "Canvas.points, summary", _datashader, f"{BATCH}; only a box known before", differs=BINS),
    Job("octomap-python", "OcTree.insertPointCloud", _octomap("octomap"), TREE, differs=None, scans=2),
    Job("pyoctomap", "OcTree.insertPointCloud", _octomap("pyoctomap"), TREE, differs=None, scans=2),
)
