"""Rows of the service's throughput: points a second over Zenoh, and replay of the log that this makes."""

import shutil
import time
from pathlib import Path

from core_rows import add_all, filled
from figures import Bench, Mark, Row, rounds_row
from scans import SCANS, SWEEP_NS, recorded, still
from serving import Sender, flood, open_session, served

from roughmap_service.cli.demo.processes import replay

ROUNDS = 8
REPLAYS = 3
ONE_THREAD = "[service]\nthreads = 1\n"


def rows(bench: Bench) -> list[Row]:
    """Points a second by shared memory and by TCP beside `add_scan` alone, one thread each; then its log replayed."""
    recording = recorded(bench.folder, 3 if bench.quick else SCANS)
    scans = len(recording.points)
    points = sum(len(p) for p in recording.points)
    folder = bench.folder / "throughput"
    shutil.rmtree(folder, ignore_errors=True)
    sender, local = Sender(recording, own_times=False), still(recording)
    taken: dict[str, list[float]] = {"shared memory": [], "TCP": [], "alone": []}
    sweeps = 0
    with served(folder, ONE_THREAD) as service:
        sessions = {
            name: open_session(service.endpoints, shared_memory=name != "TCP") for name in ("shared memory", "TCP")
        }
        with filled("cuboid", local) as alone:
            for turn in range(bench.rounds(ROUNDS) + 1):
                bench.say(f"throughput: round {turn} of {bench.rounds(ROUNDS)}")
                for name, session in sessions.items():
                    seconds = flood(session, sender, sweeps, scans)
                    sweeps += scans
                    if turn:
                        taken[name].append(points / seconds / 1e6)
                begun = time.perf_counter()
                add_all(alone, local)
                if turn:
                    taken["alone"].append(points / (time.perf_counter() - begun) / 1e6)
        for session in sessions.values():
            session.close()
    mark = Mark(0.6, "ratio", least=True)
    found = [
        rounds_row(
            f"service.{key}", f"service, log on, Zenoh {name}", "M points/s", taken[name],
            mark=mark, reference="add_scan alone, one thread each", beside=taken["alone"],
        )
        for key, name in (("shm", "shared memory"), ("tcp", "TCP"))
    ]  # fmt: skip
    found.append(_replayed(bench, folder / "log", sweeps))
    shutil.rmtree(folder)
    return found


def _replayed(bench: Bench, log: Path, sweeps: int) -> Row:
    recorded_s = sweeps * SWEEP_NS / 1e9
    times = []
    for n in range(1 if bench.quick else REPLAYS):
        bench.say(f"replay {n + 1} of {recorded_s:.0f} s of log")
        begun = time.perf_counter()
        code, verdict = replay(log, log.parent / "replay.txt")
        times.append(recorded_s / (time.perf_counter() - begun))
        if code != 0:
            raise RuntimeError(f"the log does not replay: {verdict}")
    return rounds_row(
        "replay", f"roughmap replay, {recorded_s:.0f} s at 10 Hz, the process's start in it", "x real time", times,
        mark=Mark(10.0, least=True),
    )  # fmt: skip
