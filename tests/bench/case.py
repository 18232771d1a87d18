"""The case of the issue on speed: 30 scans of 64 rings and 1024 columns over wavy ground, and a reference in C."""

import ctypes
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from roughmap import Limits, Noise, RoughMap, Scan, Trajectory, georeference

F8 = npt.NDArray[np.float64]

MAKER = Path(__file__).resolve().parents[2].parent / "shared" / "bench" / "make_scans.py"
START_NS = 1_700_000_000_000_000_000
SWEEP_NS = 100_000_000
COLUMNS = 1024
POSES_A_SWEEP = 10
CELL_SIZE = 0.1
COVERAGE, MIN_RADIUS, MIN_SHARE, MIN_DISTANCE = 2.0, 1e-3, 0.05, 1e-3
NOISE = Noise(range_sigma=0.02, beam_sigma=0.001)
POSE_VARIANCE = np.diag(np.square([0.01, 0.01, 0.01, 0.002, 0.002, 0.003]))
ORDERS = ("still", "rows", "columns", "scattered")
"""All at the stamp; with own times ring by ring, column by column, and in no order at all."""

Drive = tuple[list[Scan], Trajectory]


def drives(folder: Path, scans: int) -> dict[str, Drive]:
    """The first scans in each of the `ORDERS`, with a straight way of ten poses a sweep for those with own times."""
    made = folder / "scans.npz"
    subprocess.run([sys.executable, str(MAKER), str(made)], check=True)
    with np.load(made) as data:
        points, bounds, poses = data["points"], data["offsets"], data["poses"]
    number = len(poses)
    stamps = START_NS + SWEEP_NS * np.arange(number)
    still = _way(stamps, poses[:, :3, 3])
    # One sweep more, so that the last has a pose after it.
    fine = np.arange((number + 1) * POSES_A_SWEEP + 1) / POSES_A_SWEEP
    along = np.interp(fine, np.arange(number), poses[:, 0, 3])
    up = np.interp(fine, np.arange(number), poses[:, 2, 3])
    moving = _way(
        START_NS + SWEEP_NS // POSES_A_SWEEP * np.arange(len(fine)), np.stack([along, 0.0 * along, up], axis=1)
    )
    drives: dict[str, Drive] = {order: ([], still if order == "still" else moving) for order in ORDERS}
    for k in range(scans):
        p = points[bounds[k] : bounds[k + 1]]
        turn = np.arctan2(p[:, 1], p[:, 0]) / (2.0 * np.pi) + 0.5
        column = np.round(turn * COLUMNS).astype(np.int64) % COLUMNS
        offsets = column * (SWEEP_NS // COLUMNS)
        orders = {
            "rows": np.arange(len(p)),
            "columns": np.argsort(column, kind="stable"),
            "scattered": np.random.default_rng(k).permutation(len(p)),
        }
        drives["still"][0].append(Scan(p, int(stamps[k])))
        for name, order in orders.items():
            drives[name][0].append(Scan(np.ascontiguousarray(p[order]), int(stamps[k]), offsets[order]))
    return drives


def _way(stamps: npt.NDArray[np.int64], position: F8) -> Trajectory:
    """Poses that look straight ahead."""
    number = len(stamps)
    return Trajectory(
        stamps, position, np.tile([0.0, 0.0, 0.0, 1.0], (number, 1)), np.tile(POSE_VARIANCE, (number, 1, 1))
    )


def build(model: str, drive: Drive) -> str:
    """A map of all scans, one thread; its number of tiles and points, to show that all are the same job."""
    scans, way = drive
    with RoughMap(CELL_SIZE, model, COVERAGE, MIN_RADIUS, MIN_DISTANCE, MIN_SHARE, threads=1) as built:
        for scan in scans:
            built.add_scan(scan, way, NOISE, Limits())
        return f"{built.tile_count} tiles"


def c_core(folder: Path, drive: Drive) -> Callable[[], object] | None:
    """The core of the cuboid model in C over the same points, placed before; None without gcc."""
    gcc = shutil.which("gcc")
    if gcc is None:
        return None
    library = folder / "reference.so"
    source = Path(__file__).with_name("reference.c")
    flags = ["-O3", "-march=native", "-ffp-contract=off", "-shared", "-fPIC"]
    subprocess.run([gcc, *flags, str(source), "-o", str(library), "-lm"], check=True)
    scans, way = drive
    placed = [georeference(scan, way, NOISE) for scan in scans]
    points = np.concatenate([p[reason == 0] for p, _, reason in placed])
    variance = np.concatenate([np.diagonal(S, axis1=1, axis2=2)[reason == 0] for _, S, reason in placed])
    radii = np.maximum(COVERAGE * np.sqrt(variance), MIN_RADIUS)
    kept = radii[:, :2].max(axis=1) <= 0.5
    points, radii = points[kept], radii[kept]
    density = CELL_SIZE / radii.prod(axis=1)
    low = np.floor((points[:, :2] - radii[:, :2]).min(axis=0) / CELL_SIZE).astype(int) - 1
    high = np.floor((points[:, :2] + radii[:, :2]).max(axis=0) / CELL_SIZE).astype(int) + 1
    width, height = (high - low + 1).tolist()
    planes = [np.ascontiguousarray(plane) for plane in (*points.T, radii[:, 0], radii[:, 1], density)]
    entry = ctypes.CDLL(str(library)).integrate
    entry.restype = None
    numbers = [ctypes.c_double(v) for v in (CELL_SIZE, MIN_SHARE, MIN_DISTANCE)]
    corner = [ctypes.c_long(v) for v in (*low.tolist(), width)]

    def run() -> None:
        grid = np.zeros((height, width, 64), np.uint8)
        addresses = [ctypes.c_void_p(plane.ctypes.data) for plane in planes]
        second = ctypes.c_uint32(START_NS // 1_000_000_000)
        entry(ctypes.c_long(len(points)), *addresses, *numbers, *corner, second, ctypes.c_void_p(grid.ctypes.data))

    return run
