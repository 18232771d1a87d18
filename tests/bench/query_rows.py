"""Rows of queries: a tile and regions against a bare echo of the same bytes; derived layers."""

import shutil
import time
from itertools import product

import numpy as np
from asker import timed_get
from asking import Asker, Latencies
from figures import Bench, Mark, Row, latency_row, rounds_row
from regions import LINKS, TWO_LAYERS, Rates, filled_service, rates
from scans import CELL_SIZE, SCANS, recorded
from serving import MAP, Sender, drive

from roughmap.reading.terrain import derive

NEAR = list(product(range(-2, 2), repeat=2))
"""Tiles asked for one by one: the drive passes over them all the time."""

TILE_HZ = 40.0
"""Of the service and of the echo together."""

ROUNDS = 12


def rows(bench: Bench) -> list[Row]:
    """All figures of queries but the planner's, which is measured with the latency of scans."""
    folder = bench.folder / "queries"
    shutil.rmtree(folder, ignore_errors=True)
    sender = Sender(recorded(bench.folder, 3 if bench.quick else SCANS), own_times=True)
    seconds = 1 if bench.quick else 25
    with filled_service(bench, folder) as (service, echo, session):
        drive(session, sender, 0, 5, pose_hz=50.0, phase=0.0)
        turns = []
        for x, y in NEAR:
            selector = f"maps/{MAP}/tiles/0/{x}/{y}?{TWO_LAYERS}"
            _, size, _ = timed_get(session, selector)
            turns += [("service", selector), ("echo", f"echo?size={size};replies=1")]

        def asked() -> Asker:
            return Asker(service, TILE_HZ, seconds + bench.settle_s, bench.settle_s, echo=echo, turns=turns)

        bench.say(f"queries: a tile and its echo in turn, idle, {seconds} s")
        with asked() as asker:
            found = _tile("idle", asker.latencies(), 1.5)
        bench.say(f"queries: the same while scans come in at 10 Hz, {seconds} s")
        with asked() as asker:
            drive(session, sender, 5, round((seconds + bench.settle_s) * 10), pose_hz=50.0, phase=0.0)
            found += _tile("loaded", asker.latencies(), 3.0)
        found += _regions(rates(bench, service, echo, ROUNDS))
    shutil.rmtree(folder)
    return [*found, _derive(bench)]


def _tile(state: str, taken: Latencies, most: float) -> list[Row]:
    when = "idle" if state == "idle" else "while 10 Hz come in"
    return [
        latency_row(
            f"tile.{state}.p{p}", f"tile query, 2 layers, {when}, p{p}", taken["service"], p,
            mark=Mark(most, "ratio"), reference="echo of the same bytes", beside=taken["echo"],
        )
        for p in (50, 99)
    ]  # fmt: skip


def _regions(taken: Rates) -> list[Row]:
    """400 tiles as one grid, and as 400 replies."""
    forms = {"region": "one region", "tiles": "as 400 tile replies"}
    return [
        rounds_row(
            f"{kind}.{link}", f"400 tiles, 2 layers, {forms[kind]}, {LINKS[link]}", "MB/s", ours,
            mark=Mark(0.7, "ratio", least=True) if kind == "region" else None,
            reference="echo of the same bytes", beside=beside,
        )
        for (kind, link), (ours, beside) in taken.items()
    ]  # fmt: skip


def _derive(bench: Bench) -> Row:
    """Slope, step and traversability of one tile with its halo, from planes; numpy's gradient of the tile beside."""
    rng = np.random.default_rng(1)
    mean = np.cumsum(rng.normal(0.0, 0.01, (66, 66)), axis=0)
    spread, extent, confidence = (rng.uniform(0.0, 0.1, (64, 64)) for _ in range(3))
    runs = {
        "derive": lambda: derive(mean, CELL_SIZE, (0.5, 0.2, 0.1, 1.0, 0.9), spread, extent, confidence),
        "numpy": lambda: np.gradient(mean, CELL_SIZE),
    }
    taken: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(bench.rounds(20) + 1):
        for name, run in runs.items():
            begun = time.perf_counter()
            for _ in range(100):
                run()
            if turn:
                taken[name].append((time.perf_counter() - begun) / 100 * 1e6)
    return rounds_row(
        "derive", "derive: slope, step, traversability of a tile with its halo", "us", taken["derive"],
        mark=Mark(150.0), reference="numpy.gradient alone", beside=taken["numpy"],
    )  # fmt: skip
