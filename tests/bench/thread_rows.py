"""Rows of two threads against one: on new ground, whose pages the system must give, and on ground that is known.

Beside them what the machine lets two cores gain at all: two maps in C, made at once by two threads that share nothing.
"""

from collections.abc import Callable
from functools import partial
from threading import Thread

from core_rows import add_all, build, filled
from figures import Bench, Mark, Row, rounds_row
from reference import NoCompiler, c_whole
from scans import SCANS, recorded, still

ROUNDS = 12


def rows(bench: Bench) -> list[Row]:
    """Points a second; the digests of one thread and of two are the same."""
    drive = still(recorded(bench.folder, 3 if bench.quick else SCANS))
    known = {threads: filled("cuboid", drive, threads) for threads in (1, 2)}
    assert known[1].digest() == known[2].digest(), "two threads made other bytes than one"
    runs: dict[str, Callable[[], object]] = {}
    for threads in (1, 2):
        runs[f"new {threads}"] = partial(build, "cuboid", drive, threads)
        runs[f"known {threads}"] = partial(add_all, known[threads], drive)
    try:
        in_c = c_whole(bench.folder, drive)
        runs |= {"c 1": in_c, "c 2": lambda: _at_once(in_c)}
    except NoCompiler:
        bench.say("no gcc here: nothing to compare two threads with")
    taken = bench.interleaved(ROUNDS, runs, both=[name for name in runs if name.endswith("2")])
    work = {name: drive.points * (2 if name == "c 2" else 1) for name in runs}
    rate = {name: [work[name] / t / 1e6 for t in each] for name, each in taken.items()}
    figures = {
        "new": "add_scan, cuboid, two threads, same bytes, new ground",
        "known": "add_scan, cuboid, two threads, same bytes, known ground",
        "c": "... two maps in C at once, new ground: what the machine gives",
    }
    return [
        rounds_row(
            f"threads.{kind}", figure, "M points/s", rate[f"{kind} 2"],
            mark=None if kind == "c" else Mark(1.7, "ratio", least=True),
            reference="one map" if kind == "c" else "one thread", beside=rate[f"{kind} 1"],
        )
        for kind, figure in figures.items() if f"{kind} 1" in rate
    ]  # fmt: skip


def _at_once(run: Callable[[], object]) -> None:
    """Twice, in two threads; ctypes lets go of the interpreter's lock."""
    other = Thread(target=run)
    other.start()
    run()
    other.join()
