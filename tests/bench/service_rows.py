"""Rows of the service's throughput: points a second over Zenoh, and replay of the log that this makes."""

import shutil
import time
from pathlib import Path

from core_rows import add_all, filled
from figures import Bench, Mark, Row, rounds_row
from roughmap_commands import replay
from scans import SCANS, SWEEP_NS, recorded, still
from serving import Sender, flood, open_session, served

ROUNDS = 8
REPLAYS = 3
ONE_THREAD = "[service]\nthreads = 1\n"
LINKS = ("shared memory", "TCP")


def rows(bench: Bench) -> list[Row]:
    """Points a second by shared memory and by TCP beside `add_scan` alone, one thread each; then its log replayed."""
    folder = bench.folder / "throughput"
    taken, recorded_s = throughput(bench, folder, ROUNDS)
    mark = Mark(0.6, "ratio", least=True)
    found = [
        rounds_row(
            f"service.{key}", f"service, log on, Zenoh {name}", "M points/s", taken[name],
            mark=mark, reference="add_scan alone, one thread each", beside=taken["alone"],
        )
        for key, name in (("shm", "shared memory"), ("tcp", "TCP"))
    ]  # fmt: skip
    times = replayed(bench, folder / "log", recorded_s, REPLAYS)
    found.append(
        rounds_row(
            "replay", f"roughmap replay, {recorded_s:.0f} s at 10 Hz, the process's start in it", "x real time", times,
            mark=Mark(10.0, least=True),
        )
    )  # fmt: skip
    shutil.rmtree(folder)
    return found


def throughput(bench: Bench, folder: Path, rounds: int) -> tuple[dict[str, list[float]], float]:
    """Millions of points a second by link and ``alone``, a value a round; seconds of log that this left in ``folder``.

    ``alone`` is `add_scan` in this process, on ground that is known, as it is to the service after its first round.
    """
    recording = recorded(bench.folder, 3 if bench.quick else SCANS)
    scans = len(recording.points)
    points = sum(len(p) for p in recording.points)
    shutil.rmtree(folder, ignore_errors=True)
    sender, local = Sender(recording, own_times=False), still(recording)
    taken: dict[str, list[float]] = {name: [] for name in (*LINKS, "alone")}
    sweeps = 0
    with served(folder, ONE_THREAD) as service:
        sessions = {name: open_session(service.endpoints, shared_memory=name != "TCP") for name in LINKS}
        with filled("cuboid", local) as alone:
            for turn in range(bench.rounds(rounds) + 1):
                bench.say(f"throughput: round {turn} of {bench.rounds(rounds)}")
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
    return taken, sweeps * SWEEP_NS / 1e9


def replayed(bench: Bench, log: Path, recorded_s: float, number: int) -> list[float]:
    """How many times faster than real time the log replays, so many times in a row."""
    times = []
    for n in range(1 if bench.quick else number):
        bench.say(f"replay {n + 1} of {recorded_s:.0f} s of log")
        begun = time.perf_counter()
        replay(log)
        times.append(recorded_s / (time.perf_counter() - begun))
    return times
