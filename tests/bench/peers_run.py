"""The peers' jobs and ours, interleaved on one core; run by `peers.py` in the peers' environment."""

import json
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import numpy as np
import table
from core_rows import filled
from figures import Bench, Row, missing_row, rounds_row
from peers_jobs import JOBS, Job, Points
from scans import CELL_SIZE, NOISE, Drive, recorded, still

from roughmap import RoughMap, georeference

ROUNDS = 7
SCANS = 10
OURS = "roughmap, point model, placed points"


def placed(drive: Drive) -> Points:
    """All points in the map's frame, a scan after the other."""
    each = [georeference(scan, drive.way, NOISE)[0] for scan in drive.scans]
    return Points(each, [np.asarray(place) for place in drive.way.position])


def by_add(points: Points) -> RoughMap:
    """Ours at the peers' own job: points that are placed already, no error of theirs looked at."""
    built = RoughMap(CELL_SIZE, "point", threads=1)
    for scan in points.scans:
        built.add(scan)
    return built


def main(folder: Path, quick: bool, missing: dict[str, str]) -> int:
    bench = Bench(folder, quick)
    drive = still(recorded(folder, 3 if quick else SCANS))
    points = placed(drive)
    whole = {
        OURS: lambda: by_add(points),
        "roughmap, point model, from the sensor": lambda: filled("point", drive),
        "roughmap, cuboid model, from the sensor": lambda: filled("cuboid", drive),
    }
    cells = _known(by_add(points))
    runs: dict[str, Callable[[], object]] = dict(whole)
    sizes = dict.fromkeys(whole, drive.points)
    there: dict[str, Job] = {}
    for job in JOBS:
        if job.package in missing:
            continue
        name = f"{job.what} ({job.package} {version(job.package)})"
        part = points.first(job.scans) if job.scans else points
        run = job.prepare(part)
        made = run()
        if job.differs is not None and abs(made - cells) > job.differs * cells:
            raise RuntimeError(f"{name}: {made} cells, not our {cells}: not the same job")
        there[name], runs[name], sizes[name] = job, run, part.number
    taken = bench.interleaved(ROUNDS, runs)
    ns = {name: [t / sizes[name] * 1e9 for t in each] for name, each in taken.items()}
    rows = [
        rounds_row(
            name, name, "ns a point", each, reference="" if name == OURS else OURS,
            beside=() if name == OURS else ns[OURS], note=there[name].leaves_out if name in there else "",
        )
        for name, each in ns.items()
    ]  # fmt: skip
    rows += [missing_row(peer, peer, "ns a point", None, f"not installed: {why}") for peer, why in missing.items()]
    _tell(rows, folder, drive)
    return 0


def _known(built: RoughMap) -> int:
    with built.freeze() as frozen:
        return sum(int((frozen.records(x, y)["count"] != 0).sum()) for x, y in frozen.tiles.tolist())


def _tell(rows: list[Row], folder: Path, drive: Drive) -> None:
    print("\n".join(table.lines(rows)))
    print(f"\n{drive.points:,} points of {len(drive.scans)} scans, cells of {CELL_SIZE} m, one core. What is left out:")
    for row in rows:
        if row.note:
            print(f"- {row.figure}: {row.note}")
    (folder / "peers.json").write_text(table.as_json(rows))


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), **json.loads(sys.argv[2])))
