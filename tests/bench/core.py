"""Nanoseconds a point of `add_scan` on the scans of the issue on speed, pinned to one core, beside a reference in C.

    python tests/bench/core.py [--quick] [--json]

Every round runs everything in turn; figures are medians, ratios are medians of the rounds' own ratios, so that a busy
moment falls on both sides. The reference leaves out placing, testing and finding tiles: a rate to come near, no peer.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from statistics import median, quantiles

from case import MAKER, ORDERS, build, c_core, drives

MODELS = ("point", "cuboid", "ellipsoid")
REFERENCE = "cuboid core in C"


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="three scans, two rounds: is it whole?")
    parser.add_argument("--json", action="store_true", help="print JSON")
    given = parser.parse_args(arguments)
    if not MAKER.exists():
        print(f"the maker of the scans is not here: {MAKER}", file=sys.stderr)
        return 1
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    with tempfile.TemporaryDirectory() as folder:
        made = drives(Path(folder), 3 if given.quick else 30)
        reference = c_core(Path(folder), made["still"])
        runs = {f"{model}, {order}": partial(build, model, made[order]) for model in MODELS for order in ORDERS}
        if reference is None:
            print("no gcc: no reference in C", file=sys.stderr)
        else:
            runs[REFERENCE] = reference
        count = sum(len(scan.points) for scan in made["still"][0])
        times: dict[str, list[float]] = {name: [] for name in runs}
        for turn in range(3 if given.quick else 8):
            for name, run in runs.items():
                begun = time.perf_counter()
                run()
                if turn:  # the first one compiles
                    times[name].append((time.perf_counter() - begun) / count * 1e9)
    rows = {}
    for name, each in times.items():
        low, _, high = quantiles(each, n=4)
        beside = times.get(REFERENCE)
        ratio = median(a / b for a, b in zip(each, beside, strict=True)) if beside else None
        rows[name] = {"ns_per_point": median(each), "quartiles": [low, high], "ratio_to_c": ratio}
    if given.json:
        print(json.dumps({"points": count, "results": rows}))
        return 0
    print(f"{count:,} points, one core; ns a point: median, quartiles, ratio to the reference")
    for name, row in rows.items():
        low, high = row["quartiles"]
        ratio = "" if row["ratio_to_c"] is None else f"{row['ratio_to_c']:8.2f}"
        print(f"{name:22}{row['ns_per_point']:8.1f}{low:8.1f}{high:8.1f}{ratio}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
