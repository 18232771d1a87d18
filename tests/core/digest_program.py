"""Digests of maps that exercise every step from point to cell; also run as a program, under other instruction sets.

python tests/core/digest_program.py --keep     after a change of what cells hold: rewrite digests.json
"""

import json
import sys
from pathlib import Path

import numpy as np
from numba.core.registry import cpu_target

from roughmap import Limits, Noise, RoughMap, Scan, Trajectory

KEPT = Path(__file__).with_name("digests.json")
"""The digests on every machine, by error model and method."""

NUMBER = 6_000
"""Enough for two threads, which need about 2,000 points each."""


def scan_and_way() -> tuple[Scan, Trajectory]:
    """Return a sweep with per-point times over ten poses in UTM.

    It is made of sums, products and quotients of integers only, so that it does not depend on numpy's instruction set.
    """
    n = np.arange(NUMBER, dtype=np.int64)
    spread = np.stack([n * 7919 % 10007, n * 104729 % 9973, n * 1299709 % 2003], axis=1)
    points = (spread - (5003, 4986, 1001)) / np.array([700.0, 650.0, 900.0])
    k = np.arange(10, dtype=np.int64)
    stamps = 1_700_000_000_000_000_000 + k * 90_000_000
    position = np.array([512345.67, 5403210.98, 431.0]) + k[:, None] * np.array([0.13, -0.07, 0.011])
    rotation = np.stack([k * 0.013, k * -0.021 + 0.1, k * 0.11, 1.0 - k * 0.07], axis=1)
    row, column = np.indices((6, 6))
    one = np.where(row == column, 3.0, 1.0 / (2.0 + row + column))
    covariance = one * (1.0 + k[:, None, None] / 7.0) * 1e-5
    offsets = n * (stamps[-1] - stamps[0]) // NUMBER
    scan = Scan(points, int(stamps[0]), offsets, (0.31, -0.12, 1.07), (0.03, -0.02, 0.7, 0.71))
    return scan, Trajectory(stamps, position, rotation, covariance)


def digests(numbers_of_threads: tuple[int, ...] = (1, 2)) -> dict[str, str]:
    """Return digests by error model, method and number of threads."""
    found = {}
    scan, way = scan_and_way()
    still = Scan(scan.points.astype(np.float32), scan.stamp_ns, None, scan.translation, scan.rotation)
    noise = Noise(0.02, 0.0013, 0.0017, (0.01, 0.012, 0.009, 0.001, 0.0014, 0.002))
    rules = Limits(min_range=0.7, max_range=9.0, ceiling=0.8, ceiling_slope=0.05)
    seen = Limits(min_range=0.7, fov=(40.0, 50.0, 120.0, 90.0))
    # Bodies of all directions and thicknesses, some so thin that eigenvalues are raised.
    n = np.arange(NUMBER)
    lower = np.zeros((NUMBER, 3, 3))
    for entry, (i, j) in enumerate(((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))):
        lower[:, i, j] = (n * (31 + 12 * entry) % 97 - 40) / 1500.0
    lower[::5, 2, 2] = 0.0
    S = np.zeros((NUMBER, 3, 3))
    for m in range(3):
        S += lower[:, :, None, m] * lower[:, None, :, m]
    for model in ("point", "cuboid", "ellipsoid"):
        for threads in numbers_of_threads:
            with RoughMap(error_model=model, threads=threads, surface="all") as m:
                m.add_scan(scan, way, noise, rules)
                m.add_scan(still, way, noise, rules)
                found[f"{model}, scans, {threads}"] = m.digest()
            with RoughMap(error_model=model, threads=threads, surface="ground") as m:
                for again in range(3):
                    m.add_scan(scan, way, noise, rules)
                    m.add(scan.points * (0.9, 0.9, 0.1 * again) + way.position[0], S, scan.stamp_ns, common=1e-4)
                    m.add_scan(still, way, noise, seen, clear=True)
                found[f"{model}, ground, {threads}"] = m.digest()
            with RoughMap(error_model=model, threads=threads, surface="all") as m:
                m.add(scan.points, S, scan.stamp_ns)
                found[f"{model}, points, {threads}"] = m.digest()
    return found


def machine() -> dict[str, str]:
    """Return the CPU and its features that kernels are compiled for."""
    _, cpu, features = cpu_target.target_context.codegen().magic_tuple()
    return {"cpu": cpu, "features": features}


def main() -> None:
    found = digests()
    if sys.argv[1:] == ["--keep"]:
        alone = {name[: -len(", 1")]: digest for name, digest in found.items() if name.endswith(", 1")}
        KEPT.write_text(json.dumps(alone, indent=2) + "\n")
        return
    print(json.dumps({**machine(), "digests": found}))


if __name__ == "__main__":
    main()
