"""Rows over the number of tiles held: the same drive, trimmed to ten tiles, on maps that hold more and more.

A map is filled by a point a tile, in a block of tiles as near to a square as ten allow: such a tile costs one page, not
its 256 KiB. The drive then takes place on the block's ten-tile sites in turn, a site a round, each driven over once
before, so that its pages are there and what is timed is the map's size and nothing else. Beside it the hard case: every
scan somewhere else.
"""

from collections.abc import Callable
from itertools import cycle

import numpy as np
from core_rows import add_all
from figures import Bench, Mark, Row, rounds_row
from scans import CELL_SIZE, NOISE, SCANS, Drive, recorded, still, within

from roughmap import RoughMap

ROUNDS = 12
HELD = (10, 1_000, 20_000)
TILE_M = 64 * CELL_SIZE
ACROSS, ALONG = 2, 5
"""Tiles of a site along x and y."""

MARGIN_M = 0.5
"""No footprint leaves the site."""

SITES = 12
"""Of a map's sites so many are driven over, evenly spread; a page is 64 cells, and each site costs 2.6 MB."""


class Held:
    """A map that holds ``number`` tiles, and the trimmed drive at some of its sites."""

    def __init__(self, number: int, drives: list[Drive], sites: list[tuple[int, int]]) -> None:
        self.map = RoughMap(CELL_SIZE, threads=1)
        self._drives = drives
        self._fill(sites)
        assert self.map.tile_count == number, f"{self.map.tile_count} tiles, not {number}"
        for drive in self._drives:
            add_all(self.map, drive)
        assert self.map.tile_count == number, "the drive left its site"
        self._turns = cycle(self._drives)

    def _fill(self, sites: list[tuple[int, int]]) -> None:
        middles = [
            ((ACROSS * sx + i + 0.5) * TILE_M, (ALONG * sy + j + 0.5) * TILE_M, 0.0)
            for sx, sy in sites
            for i in range(ACROSS)
            for j in range(ALONG)
        ]
        self.map.add(np.array(middles), np.eye(3) * 1e-6)

    def drive(self) -> None:
        """All scans at the next site."""
        add_all(self.map, next(self._turns))

    def jump(self) -> None:
        """As many scans, each at another site than the one before."""
        for k in range(len(self._drives[0].scans)):
            drive = next(self._turns)
            self.map.add_scan(drive.scans[k], drive.way, NOISE)


def rows(bench: Bench) -> list[Row]:
    """Cost a point at each number of tiles held, against that at ten."""
    half = ACROSS * TILE_M / 2, ALONG * TILE_M / 2
    trimmed = within(recorded(bench.folder, 3 if bench.quick else SCANS), half[0] - MARGIN_M, half[1] - MARGIN_M)
    maps = {}
    for number in HELD:
        sites = _block(number // (ACROSS * ALONG))
        chosen = sites[:: max(len(sites) // (2 if bench.quick else SITES), 1)]
        at = [((ACROSS * x) * TILE_M + half[0], (ALONG * y) * TILE_M + half[1]) for x, y in chosen]
        maps[number] = Held(number, [still(trimmed, shift) for shift in at], sites)
    points = sum(len(p) for p in trimmed.points)
    runs: dict[str, Callable[[], object]] = {f"{n:,} tiles": held.drive for n, held in maps.items()}
    runs |= {f"{n:,} tiles, jumping": held.jump for n, held in maps.items() if n > 10}
    bench.say(f"tiles held: {points:,} points a drive")
    ns = {name: [t / points * 1e9 for t in each] for name, each in bench.interleaved(ROUNDS, runs).items()}
    least = f"{HELD[0]} tiles"
    found = []
    for n in HELD:
        beside = {} if n == HELD[0] else {"reference": f"{HELD[0]} tiles", "beside": ns[least]}
        mark = None if n == HELD[0] else Mark(1.1, "ratio")
        found.append(
            rounds_row(
                f"held.{n}", f"add_scan, {n:,} tiles held", "ns a point", ns[f"{n:,} tiles"], mark=mark, **beside
            )
        )
    jumping = [
        rounds_row(
            f"held.{n}.jumping", f"... {n:,} tiles held, every scan at another place", "ns a point",
            ns[f"{n:,} tiles, jumping"], reference=f"{HELD[0]} tiles", beside=ns[least],
        )
        for n in HELD[1:]
    ]  # fmt: skip
    return [*found, *jumping]


def _block(number: int) -> list[tuple[int, int]]:
    """So many sites side by side, whose tiles fill a block as near to a square as may be."""
    rows = max(round((number * ACROSS / ALONG) ** 0.5), 1)
    return [(n // rows, n % rows) for n in range(number)]
