"""Rows of latency: from a scan to the map, and a planner's question, while scans come in at 10 Hz; the log's size."""

import shutil

from asking import Asker
from figures import Bench, Mark, Row, latency_row, rounds_row
from scans import COLUMNS, SCANS, recorded
from serving import ROBOT, Sender, drive, open_session, served

PLANNER_HZ = 20.0
POSE_HZ = (10.0, 50.0, 200.0)
LATE_PHASE = 0.37
"""Odometry and sweeps know nothing of each other."""


def rows(bench: Bench) -> list[Row]:
    """Latencies at 65k and 131k points a scan with a planner beside, then by the rate of odometry."""
    folder = bench.folder / "latency"
    shutil.rmtree(folder, ignore_errors=True)
    scans = 3 if bench.quick else SCANS
    senders = {
        name: Sender(recorded(bench.folder, scans, columns), own_times=True, robot=f"{ROBOT}{name}")
        for name, columns in (("65k", COLUMNS), ("131k", 2 * COLUMNS))
    }
    found: list[Row] = []
    with served(folder) as service, open_session(service.endpoints) as session:
        first = 0
        for name, planned, mark in (("65k", 30, 30.0), ("131k", 20, 60.0)):
            seconds = 1 if bench.quick else planned
            skip = round(bench.settle_s * 10)
            bench.say(f"latency: {name} points at 10 Hz, {PLANNER_HZ:g} queries a second, {seconds} s")
            sweeps = skip + seconds * 10
            asker = Asker(service.endpoints, PLANNER_HZ, seconds + bench.settle_s, bench.settle_s, planner=True)
            with asker as planner:
                driven = drive(session, senders[name], first, sweeps, pose_hz=50.0, phase=0.0, skip=skip)
                asked = planner.latencies()["planner"]
            first += sweeps
            figure = f"scan of {name} points to queryable, 10 Hz, log on, 20 queries a second"
            found += [
                latency_row(f"latency.{name}.p50", f"{figure}, p50", driven.latency, 50),
                latency_row(f"latency.{name}.p99", f"{figure}, p99", driven.latency, 99, mark=Mark(mark)),
            ]
            if name == "65k":
                figure = "planner: 20 x 20 m, 2 layers, 20 a second, while 10 Hz come in"
                found += [
                    latency_row("planner.p50", f"{figure}, p50", asked, 50),
                    latency_row("planner.p99", f"{figure}, p99", asked, 99, mark=Mark(15.0)),
                ]
        for hz in POSE_HZ:
            sweeps = 5 if bench.quick else 100
            bench.say(f"latency: odometry at {hz:g} Hz, {sweeps / 10:g} s")
            # A robot of its own: its odometry does not begin before the end of the one before.
            sender = senders[f"{hz:g}"] = Sender(
                recorded(bench.folder, scans, COLUMNS), own_times=True, robot=f"{ROBOT}{hz:g}"
            )
            driven = drive(session, sender, first, sweeps, pose_hz=hz, phase=LATE_PHASE)
            first += sweeps
            figure = f"a sweep's end to queryable, 65k points, odometry at {hz:g} Hz"
            found += [
                latency_row(f"whole.{hz:g}.p50", f"{figure}, p50", driven.whole, 50),
                latency_row(f"whole.{hz:g}.p99", f"{figure}, p99", driven.whole, 99),
            ]
    log = sum(path.stat().st_size for path in (folder / "log").glob("*.mcap"))
    sent = sum(sender.bytes for sender in senders.values())
    found.append(
        rounds_row("log", "log bytes against input bytes", "MB", [log / 1e6], mark=Mark(1.2, "ratio"),
                   reference="input", beside=[sent / 1e6])
    )  # fmt: skip
    shutil.rmtree(folder)
    return found
