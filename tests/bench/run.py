"""Nanoseconds a point: from sensor-frame points to updated cells, for each error model, on one thread.

    python tests/bench/run.py [--quick] [--json]

Beside it, in the same run and over the same points, the plainest thing that numpy can do: a group-by of points that
are already placed, for mean and standard deviation alone. The ratio to it holds from machine to machine and from hour
to hour; the nanoseconds don't. Each figure is the best of several rounds, after one that compiles.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from roughmap import Limits, Noise, RoughMap, Scan, Trajectory
from roughmap_service.rover import MOUNT, POSE_SIGMA, rovers
from roughmap_service.rover_scanner import Scanner

CELL_SIZE = 0.1
MODELS = ("point", "cuboid", "ellipsoid")
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


def best(rounds: int, run: Callable[[], object]) -> float:
    """The shortest of some runs, seconds."""
    times = []
    for _ in range(rounds):
        begun = time.perf_counter()
        run()
        times.append(time.perf_counter() - begun)
    return min(times)


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
    plain = best(rounds, lambda: group_by(placed)) / count * 1e9
    rows: dict[str, dict[str, float]] = {"numpy group-by": {"ns_per_point": plain, "ratio": 1.0}}
    for model in MODELS:
        integrate(model, scans[:1], trajectory)
        nanoseconds = best(rounds, lambda model=model: integrate(model, scans, trajectory)) / count * 1e9  # type: ignore[misc]
        rows[model] = {"ns_per_point": nanoseconds, "ratio": nanoseconds / plain}
    if given.json:
        print(json.dumps({"points": count, "scans": len(scans), "results": rows}))
        return 0
    print(f"{count:,} points in {len(scans)} scans, cells of {CELL_SIZE} m, one thread")
    print(f"{'':16}{'ns a point':>12}{'to group-by':>13}")
    for name, row in rows.items():
        print(f"{name:16}{row['ns_per_point']:12.1f}{row['ratio']:13.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
