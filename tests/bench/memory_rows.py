"""Rows of memory: resident bytes a known cell, and the rate past `memory_limit` against in memory."""

from figures import Bench, Mark, Row, rounds_row
from memory import measure


def rows(bench: Bench) -> list[Row]:
    """All of them, measured by a process of its own."""
    bench.say("memory: a dense map, the drive, and a road past a memory limit of a quarter of its map")
    made = measure(bench.folder, quick=bench.quick)
    unit = "bytes a known cell"
    spilled = f"{made['spilled']} of {made['tiles']} tiles spilled in the end"
    return [
        rounds_row("memory.dense", "resident, dense map", unit, [made["dense_bytes"]], mark=Mark(70.0)),
        rounds_row("memory.drive", "... the benchmark's drive", unit, [made["drive_bytes"]], mark=Mark(200.0)),
        rounds_row(
            "memory.spilling", "points a second past memory_limit, a quarter of the map, against in memory", "x",
            made["ratio"], mark=Mark(0.5, least=True), note=spilled,
        ),
    ]  # fmt: skip
