"""Resident bytes a known cell, and what a map costs that is larger than its memory limit.

    python tests/bench/memory.py [--quick]

Prints one JSON object. `measure` runs it in a process of its own: what others measured before leaves holes in the heap,
into which a map would grow unseen.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from scans import CELL_SIZE, NOISE, SCANS, Drive, Recording, recorded, still

from roughmap import RoughMap

LAP_M = 9.0
"""A lap is the recorded drive; the next one begins where it ends."""

BACK_EVERY, BACK_BY = 8, 5
"""After so many laps on new ground one over the ground of so many laps before."""


def measure(folder: Path, *, quick: bool) -> dict[str, Any]:
    """All figures, from a process of its own: ``dense_bytes`` and ``drive_bytes`` resident a known cell;
    ``ratio``, the points a second past a memory limit of a quarter of the map against in memory (a list, a round
    each), with ``tiles``, ``limit_bytes``, ``map_bytes`` and ``spilled_bytes`` (written a round) beside."""
    command = [sys.executable, __file__, "--folder", str(folder), *(["--quick"] if quick else [])]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    made: dict[str, Any] = json.loads(done.stdout)
    return made


def memory_bytes() -> int:
    """This process's resident memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def known_cells(held: RoughMap) -> int:
    """How many cells of a map are known."""
    with held.freeze() as frozen:
        return sum(frozen.known_cells(x, y) for x, y in frozen.tiles.tolist())


def dense_bytes(side: int) -> float:
    """A square of ``side`` tiles in which every cell is known, filled tile by tile."""
    cells = np.stack(np.meshgrid(np.arange(64), np.arange(64), indexing="xy"), axis=-1).reshape(-1, 2)
    held = RoughMap(CELL_SIZE, "point", threads=1)
    points = np.zeros((len(cells), 3))

    def fill(x: int, y: int) -> None:
        points[:, :2] = (cells + [64 * x, 64 * y] + 0.5) * CELL_SIZE
        held.add(points)

    fill(-1, -1)  # what a map needs besides tiles is there after the first
    before = memory_bytes()
    for x in range(side):
        for y in range(side):
            fill(x, y)
    return (memory_bytes() - before) / (known_cells(held) - len(cells))


def drive_bytes(recording: Recording) -> float:
    """The benchmark's drive. The memory of a scan's points, which every map needs, was used once before."""
    drive = still(recording)
    held = RoughMap(CELL_SIZE, threads=1)
    for scan in drive.scans:
        held.add_scan(scan, drive.way, NOISE)
    held.reset()
    before = memory_bytes()
    for scan in drive.scans:
        held.add_scan(scan, drive.way, NOISE)
    return (memory_bytes() - before) / known_cells(held)


def laps(number: int) -> list[int]:
    """The places of the laps along the road: ahead, and now and then back."""
    order: list[int] = []
    for lap in range(number):
        order.append(lap)
        if lap % BACK_EVERY == BACK_EVERY - 1:
            order.append(lap - BACK_BY)
    return order


class Plain:
    """The map in memory, and how much of that it took: what another beside it must not be blamed for."""

    def __init__(self) -> None:
        self.map = RoughMap(CELL_SIZE, threads=1)
        self.bytes = 0

    def lap(self, drive: Drive) -> float:
        """Seconds of one lap."""
        before, begun = memory_bytes(), time.perf_counter()
        for scan in drive.scans:
            self.map.add_scan(scan, drive.way, NOISE)
        seconds = time.perf_counter() - begun
        self.bytes += memory_bytes() - before
        return seconds


def spilling(folder: Path, recording: Recording, number: int, rounds: int) -> dict[str, Any]:
    """A map in memory and one past a limit of a quarter of what the first takes in all, lap by lap in turn, so that a
    busy moment falls on both. The digests are equal."""
    # Here, for other versions have these elsewhere, and are measured by the rest of this module all the same.
    from roughmap_service.store.memory_limit import MemoryLimit
    from roughmap_service.store.spill import Spill

    order = laps(number)
    drives = [still(recording, (LAP_M * lap, 0.0)) for lap in order]
    plain = Plain()
    for drive in drives:
        plain.lap(drive)
    limit = plain.bytes // 4
    result: dict[str, Any] = {"tiles": plain.map.tile_count, "map_bytes": plain.bytes, "limit_bytes": limit}
    result["ratio"] = []
    for _ in range(rounds):
        plain.map.reset()
        plain, written = Plain(), Counted()
        with Spill(folder / "tiles.spill", 1 << 40, write=written.write) as spill:
            held = RoughMap(CELL_SIZE, threads=1, shelf=spill)
            beside = plain
            memory = MemoryLimit(limit, spill, measure=lambda beside=beside: memory_bytes() - beside.bytes)
            seconds = np.zeros(2)
            for drive in drives:
                seconds[0] += plain.lap(drive)
                begun = time.perf_counter()
                for scan in drive.scans:
                    memory.relieve(lambda held=held: nullcontext(held))
                    held.add_scan(scan, drive.way, NOISE)
                seconds[1] += time.perf_counter() - begun
            assert held.digest() == plain.map.digest()
            result["ratio"].append(seconds[0] / seconds[1])
            result["spilled"], result["spilled_bytes"] = held.tile_count - held.resident_tiles, written.bytes
            held.reset()
    return result


class Counted:
    """Writes, and counts the bytes."""

    def __init__(self) -> None:
        self.bytes = 0

    def write(self, file: int, parts: Any, offset: int) -> int:
        done = os.pwritev(file, parts, offset)
        self.bytes += done
        return done


def main(arguments: list[str]) -> int:
    quick = "--quick" in arguments
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(arguments[arguments.index("--folder") + 1] if "--folder" in arguments else temporary)
        recording = recorded(folder, 3 if quick else SCANS)
        figures = {"dense_bytes": dense_bytes(8 if quick else 32), "drive_bytes": drive_bytes(recording)}
        figures |= spilling(Path(temporary), recording, 10 if quick else 32, 1 if quick else 3)
    print(json.dumps(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
