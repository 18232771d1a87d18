"""What it costs, in one table: figure, mark, measured, reference beside it, met or not.

    python tests/bench/run.py [--quick] [--only GROUP] [--out FOLDER]

Figures are medians over rounds in which all that is compared runs in turn, with quartiles beside; latencies are
percentiles. The table goes to standard output, and with all samples to FOLDER/bench.json, pictures beside it. `--quick`
shows in under a minute that all of it works; its times mean nothing.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import core_rows
import held_rows
import latency_rows
import memory_rows
import pictures
import query_rows
import service_rows
import start_rows
import table
import thread_rows
from figures import Bench, Row

GROUPS: dict[str, Callable[[Bench], list[Row]]] = {
    "core": core_rows.rows,
    "threads": thread_rows.rows,
    "held": held_rows.rows,
    "service": service_rows.rows,
    "latency": latency_rows.rows,
    "queries": query_rows.rows,
    "memory": memory_rows.rows,
    "start": start_rows.rows,
}


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few scans, two rounds: is it whole?")
    parser.add_argument("--only", action="append", choices=list(GROUPS), help="this group of rows; may be repeated")
    parser.add_argument("--out", type=Path, default=Path("bench"), help="for table, JSON, pictures and scans [bench]")
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    bench = Bench(given.out.resolve(), given.quick)
    begun = time.monotonic()
    rows: list[Row] = []
    for name in given.only or GROUPS:
        bench.say(f"group {name}")
        rows += GROUPS[name](bench)
    seconds = time.monotonic() - begun
    text = "\n".join(table.lines(rows))
    (given.out / "bench.md").write_text(text + "\n")
    (given.out / "bench.json").write_text(table.as_json(rows, quick=given.quick, seconds=round(seconds, 1)))
    drawn = pictures.draw(rows, given.out)
    print(text)
    bench.say(f"{seconds:.0f} s; {given.out}/bench.json, {', '.join(path.name for path in drawn) or 'no picture'}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
