"""How far the stated confidence is from what holds, in a simulation that knows the truth of every cell."""

import math
from collections.abc import Sequence

import confidence
from right_row import Row

FEWEST = 1000
"""Cells of a stratum, for its share to be known to about a point of percent."""

MARK = 3.0
"""Points of percent."""

AT_ONCE = "two robots at once"
"""Judged by itself: a cell does not know whose pose its last point had, and takes the errors of two robots that stand
side by side for one and the same. It believes itself too little, never too much."""


def rows(seed: int, cells: int) -> list[Row]:
    """The worst stratum of each error model: points of percent between a stated probability, 50 to 99 %, and how often
    the true height lay within; beside it the same of the paper's confidence level."""
    table = [row for row in confidence.coverage_table(seed, cells) if row.cells >= FEWEST]
    made = []
    for model in dict.fromkeys(row.stratum for row in table):
        own = [row for row in table if row.stratum == model]
        on = f"simulated, {model}"
        made += [
            _worst(on, [row for row in own if row.pose_error != AT_ONCE], ""),
            _worst(f"{on}, {AT_ONCE}", [row for row in own if row.pose_error == AT_ONCE], "known limit: a cell does "
                   "not know whose pose its last point had, so it believes itself too little; "),
        ]  # fmt: skip
    return made


def _worst(on: str, own: Sequence[confidence.Row], why: str) -> Row:
    worst = max(own, key=lambda row: abs(row.covered - row.stated))
    paper = max(100.0 * abs(row.paper - row.stated) for row in own if not math.isnan(row.paper))
    differ = [100.0 * (row.covered - row.stated) for row in own]
    beyond = sum(abs(points) > MARK for points in differ)
    note = (f"{why}beyond in {beyond} of {len(own)} strata and levels; claims too much by at most "
            f"{max(0.0, -min(differ)):.1f}; worst: {worst.points} points, {worst.scans} scans, {worst.pose_error}, "
            f"{worst.ground}: {worst.stated:.0%} stated, {worst.covered:.1%} of {worst.cells} cells held")  # fmt: skip
    off = 100.0 * abs(worst.covered - worst.stated)
    return Row(on, "confidence off at most", "points", off, MARK, before=paper, note=note)
