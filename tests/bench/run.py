"""Nanoseconds a point: from sensor-frame points to updated cells, for each error model, on one thread.

Once with each point placed at its own time between two poses (deskewed), once all of a scan at its stamp (still).

    python tests/bench/run.py [--quick] [--json]

Beside it, in the same run and over the same points, the plainest thing that numpy can do: a group-by of points that
are already placed, for mean and standard deviation alone. The ratio to it holds better from machine to machine and
from hour to hour than the nanoseconds do: every round runs everything in turn, so that a busy moment falls on all.
Each figure is the best of its rounds, after one that compiles. Ratios with and without --quick don't compare: sorting
takes longer a point where there are more.
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import numpy.typing as npt

from roughmap import Limits, Noise, RoughMap, Scan, Trajectory
from roughmap_service.rover import MOUNT, POSE_SIGMA, rovers
from roughmap_service.rover_scanner import Scanner

CELL_SIZE = 0.1
MODELS = ("point", "cuboid", "ellipsoid")
GROUP_BY = "numpy group-by"
START_NS = 1_700_000_000_000_000_000

Drive = tuple[list[Scan], Trajectory, npt.NDArray[np.float64]]


def drive(scans: int) -> Drive:
    """Some scans of the simulated rover, its true poses, and all points placed."""
    scanner = Scanner(rings=64, columns=1024)
    (rover,) = rovers(1, seed=1, start_ns=START_NS, scanner=scanner)
    stamps = START_NS + np.arange(scans * 5 + 2, dtype=np.int64) * 20_000_000
    true = rover.pose(stamps)
    from scipy.spatial.transform import Rotation

    covariance = np.tile(np.diag(np.square(POSE_SIGMA)), (len(stamps), 1, 1))
    trajectory = Trajectory(stamps, true.position, Rotation.from_matrix(true.rotation).as_quat(), covariance)
    rng = np.random.default_rng(0)
    made, placed = [], []
    for k in range(scans):
        stamp = START_NS + k * scanner.sweep_ns
        pose = rover.pose(stamp + scanner.column_offsets_ns())
        position = pose.position + np.einsum("nij,j->ni", pose.rotation, np.asarray(MOUNT))
        points, offsets = scanner.sweep(rover.ground, position, pose.rotation, rng)
        back = (points != 0).any(axis=1)
        made.append(Scan(points[back].astype(np.float64), stamp, offsets[back], translation=MOUNT))
        column = np.repeat(np.arange(scanner.columns), scanner.rings)[back]
        placed.append(np.einsum("nij,nj->ni", pose.rotation[column], points[back]) + position[column])
    return made, trajectory, np.concatenate(placed)


def group_by(points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Mean and standard deviation a cell by numpy alone: sort by cell, then sums over the runs of equal cells."""
    i = np.floor(points[:, 0] / CELL_SIZE).astype(np.int64)
    j = np.floor(points[:, 1] / CELL_SIZE).astype(np.int64)
    key = (i << 32) + j
    order = np.argsort(key, kind="stable")
    begin = np.flatnonzero(np.diff(key[order], prepend=key[order[0]] - 1))
    z = points[order, 2]
    count = np.diff(begin, append=len(z))
    mean = np.add.reduceat(z, begin) / count
    return np.sqrt(np.add.reduceat((z - np.repeat(mean, count)) ** 2, begin) / np.maximum(count - 1, 1))


def best(rounds: int, runs: dict[str, Callable[[], object]]) -> dict[str, float]:
    """The shortest time of each of some runs, seconds; all of them once in every round."""
    times = dict.fromkeys(runs, math.inf)
    for _ in range(rounds):
        for name, run in runs.items():
            begun = time.perf_counter()
            run()
            times[name] = min(times[name], time.perf_counter() - begun)
    return times


def integrate(model: str, scans: list[Scan], trajectory: Trajectory) -> RoughMap:
    """A map of all scans."""
    built = RoughMap(cell_size=CELL_SIZE, error_model=model, threads=1)
    noise = Noise(range_sigma=0.02, beam_sigma=0.0005)
    for scan in scans:
        built.add_scan(scan, trajectory, noise, Limits(min_range=0.5))
    return built


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few scans, few rounds: does it run, and roughly how fast")
    parser.add_argument("--json", action="store_true", help="print JSON")
    given = parser.parse_args(arguments)
    scans, trajectory, placed = drive(4 if given.quick else 30)
    rounds = 2 if given.quick else 5
    count = sum(len(scan.points) for scan in scans)
    still = [Scan(scan.points, scan.stamp_ns, translation=MOUNT) for scan in scans]
    runs: dict[str, Callable[[], object]] = {GROUP_BY: partial(group_by, placed)}
    for model in MODELS:
        for name, kind in (("deskewed", scans), ("still", still)):
            integrate(model, kind[:1], trajectory)
            runs[f"{model}, {name}"] = partial(integrate, model, kind, trajectory)
    each = {name: seconds / count * 1e9 for name, seconds in best(rounds, runs).items()}
    rows = {name: {"ns_per_point": value, "ratio": value / each[GROUP_BY]} for name, value in each.items()}
    if given.json:
        print(json.dumps({"points": count, "scans": len(scans), "results": rows}))
        return 0
    print(f"{count:,} points in {len(scans)} scans, cells of {CELL_SIZE} m, one thread")
    print(f"{'':22}{'ns a point':>12}{'to group-by':>13}")
    for name, row in rows.items():
        print(f"{name:22}{row['ns_per_point']:12.1f}{row['ratio']:13.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
