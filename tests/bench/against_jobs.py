"""What a fresh process measures of one version: `against_jobs.py JSON`, its values as JSON on standard output.

The JSON: job; tree (the version's); scans (folder); work (an empty folder); keys (the rows that are wanted); quick;
data (a folder of recordings) or not.
Everything here uses only what versions have in common: the public names of the packages, and the command line.
"""

import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from figures import Bench

if TYPE_CHECKING:
    from roughmap import RoughMap

RECORDED = {"hall", "offroad", "broken"}
"""Kernel rows of recorded points."""

Fills = dict[str, tuple[int, Callable[[], "RoughMap"]]]
"""By row: the number of points, and what makes their map."""


@dataclass
class Measured:
    """``values`` by row; why there is none (``missing``); digests of the maps that were made, by name (``maps``)."""

    values: dict[str, float] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    maps: dict[str, str] = field(default_factory=dict)


def kernel(bench: Bench, work: Path, keys: set[str], found: Measured) -> None:
    """CPU time of one thread on one core: the least of the rounds, since what disturbs only adds."""
    from core_rows import add_all, filled
    from scans import SCANS, moving, recorded, still

    recording = recorded(bench.folder, 3 if bench.quick else SCANS)
    kinds = {
        "new": ("cuboid", still(recording)),
        "known": ("cuboid", still(recording)),
        "deskew": ("cuboid", moving(recording, "rows")),
        "scattered": ("cuboid", moving(recording, "scattered")),
        "point": ("point", still(recording)),
        "ellipsoid": ("ellipsoid", still(recording)),
    }
    wanted = {key.split(".")[1] for key in keys} | ({"new"} if "kernel.deskew.cost" in keys else set())
    fills: Fills = {name: (drive.points, partial(filled, model, drive)) for name, (model, drive) in kinds.items()}
    fills |= _of_recordings(bench, found) if wanted & RECORDED else {}
    runs: dict[str, Callable[[], object]] = {}
    for name in fills.keys() & wanted:
        make = fills[name][1]
        try:
            held = make()
            found.maps[name] = held.digest()
        except Exception as error:  # noqa: BLE001 - whatever an old version can't do, the other rows go on
            found.missing[f"kernel.{name}"] = f"{type(error).__name__}: {error}"
            continue
        if name == "known":
            runs[name] = partial(add_all, held, kinds[name][1])
        else:
            held.close()
            runs[name] = partial(_make, make)
    taken = bench.interleaved(9, runs, clock=time.process_time)
    seconds = {name: min(each) for name, each in taken.items()}
    found.values |= {f"kernel.{name}": s / fills[name][0] * 1e9 for name, s in seconds.items()}
    if {"new", "deskew"} <= seconds.keys():
        found.values["kernel.deskew.cost"] = seconds["deskew"] / seconds["new"]


def _make(make: Callable[[], "RoughMap"]) -> None:
    make().close()


def _of_recordings(bench: Bench, found: Measured) -> Fills:
    """The maps of recorded points: how many, and what makes one; none without the folder, and the rows say why."""
    from core_rows import filled

    if bench.data is None:
        found.missing |= {f"kernel.{name}": "needs recordings: --data FOLDER" for name in RECORDED}
        return {}
    import recorded_drives

    drives = {"hall": recorded_drives.hall(bench.data), "offroad": recorded_drives.offroad(bench.data)}
    points = recorded_drives.survey(bench.data)
    made = {name: (drive.points, partial(filled, "cuboid", drive)) for name, drive in drives.items()}
    return made | {"broken": (len(points), partial(recorded_drives.surveyed, points))}


def threads(bench: Bench, work: Path, keys: set[str], found: Measured) -> None:
    """Wall time of two threads on two cores, and of one: the least of the rounds."""
    from core_rows import add_all, build, filled
    from scans import SCANS, recorded, still

    drive = still(recorded(bench.folder, 3 if bench.quick else SCANS))
    runs: dict[str, Callable[[], object]] = {}
    for number in (1, 2):
        held = filled("cuboid", drive, number)
        found.maps[f"threads {number}"] = held.digest()
        runs[f"new {number}"] = partial(build, "cuboid", drive, number)
        runs[f"known {number}"] = partial(add_all, held, drive)
    taken = bench.interleaved(6, runs, both=("new 2", "known 2"))
    for ground in ("new", "known"):
        one, two = min(taken[f"{ground} 1"]), min(taken[f"{ground} 2"])
        found.values[f"threads.{ground}"] = two / drive.points * 1e9
        found.values[f"threads.{ground}.gain"] = one / two


def memory(bench: Bench, work: Path, keys: set[str], found: Measured) -> None:
    """Resident bytes a known cell."""
    from memory import dense_bytes, drive_bytes
    from scans import SCANS, recorded

    recording = recorded(bench.folder, 3 if bench.quick else SCANS)
    found.values["memory.dense"] = dense_bytes(8 if bench.quick else 32)
    found.values["memory.drive"] = drive_bytes(recording)


def service(bench: Bench, work: Path, keys: set[str], found: Measured) -> None:
    """Points a second by both links, and beside the library in this process; then the log replayed once."""
    from service_rows import replayed, throughput

    taken, recorded_s = throughput(bench, work / "service", 5)
    for key, link in (("tcp", "TCP"), ("shm", "shared memory")):
        found.values[f"service.{key}"] = float(np.median(taken[link]))
        found.values[f"service.{key}.share"] = float(np.median(np.divide(taken[link], taken["alone"])))
    if "service.replay" in keys:
        (found.values["service.replay"],) = replayed(bench, work / "service" / "log", recorded_s, 1)


def region(bench: Bench, work: Path, keys: set[str], found: Measured) -> None:
    """MB/s of one region by both links, and beside an echo."""
    from regions import filled_service, rates

    with filled_service(bench, work / "region") as (endpoints, echo, _):
        for (_, link), (ours, echoed) in rates(bench, endpoints, echo, 7, ("region",)).items():
            found.values[f"region.{link}"] = float(np.median(ours))
            found.values[f"region.{link}.share"] = float(np.median(np.divide(ours, echoed)))


def robot(bench: Bench, work: Path, keys: set[str], found: Measured) -> None:
    """The service's CPU and latencies at a robot's pace, beside the library's CPU for the same scans at that pace."""
    from asking import Asker
    from core_rows import filled
    from scans import COLUMNS, NOISE, SCANS, moving, recorded
    from service_rows import ONE_THREAD
    from serving import Sender, drive, open_session, served

    recording = recorded(bench.folder, 3 if bench.quick else SCANS, 2 * COLUMNS)
    sender = Sender(recording, own_times=True)
    first, sweeps = round(bench.settle_s * 10), 10 if bench.quick else 200
    with (
        served(work / "robot", ONE_THREAD) as process,
        open_session(process.endpoints) as session,
        Asker(process.endpoints, 20.0, (first + sweeps) / 10, bench.settle_s, planner=True) as planner,
    ):
        drive(session, sender, 0, first, pose_hz=50.0, phase=0.0)
        before = process.cpu_s()
        driven = drive(session, sender, first, sweeps, pose_hz=50.0, phase=0.0)
        whole = (process.cpu_s() - before) / sweeps
        asked = planner.latencies()["planner"]
    alone = 0.0
    local = moving(recording, "columns")
    with filled("cuboid", local) as held:
        begun = time.perf_counter()
        for k, scan in enumerate(local.scans):
            time.sleep(max(begun + 0.1 * k - time.perf_counter(), 0.0))
            before = time.process_time()
            held.add_scan(scan, local.way, NOISE)
            alone += (time.process_time() - before) / len(local.scans)
    found.values |= {"robot.cpu": whole * 1e3, "robot.cpu.beside": (whole - alone) * 1e3}
    for p in (50, 99):
        found.values[f"robot.p{p}"] = float(np.percentile(driven.latency, p)) * 1e3
        found.values[f"robot.planner.p{p}"] = float(np.percentile(asked, p)) * 1e3


CORE = ("roughmap",)
ALL = ("roughmap", "roughmap_schemas", "roughmap_client", "roughmap_service")
JOBS = {
    "kernel": (kernel, CORE),
    "threads": (threads, CORE),
    "memory": (memory, CORE),
    "service": (service, ALL),
    "region": (region, ALL),
    "robot": (robot, ALL),
}
"""What to call, and which packages it must find in the version's tree."""


def check_packages(tree: Path, packages: tuple[str, ...]) -> None:
    """RuntimeError unless all are the tree's own: what it lacks would be found where another version is installed."""
    for name in packages:
        there = find_spec(name)
        if there is None or there.origin is None or not Path(there.origin).resolve().is_relative_to(tree.resolve()):
            raise RuntimeError(f"this version has no package {name}")


def main(given: dict[str, Any]) -> int:
    measure, packages = JOBS[given["job"]]
    check_packages(Path(given["tree"]), packages)
    found = Measured()
    keys = set(given["keys"])
    bench = Bench(Path(given["scans"]), given["quick"], Path(given["data"]) if given.get("data") else None)
    measure(bench, Path(given["work"]), keys, found)
    values = {key: value for key, value in found.values.items() if key in keys}
    print(json.dumps({"values": values, "missing": found.missing, "maps": found.maps}))
    return 0


if __name__ == "__main__":
    sys.exit(main(json.loads(sys.argv[1])))
