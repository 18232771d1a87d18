"""How far the stated confidence is from what holds, in a simulation that knows the truth of every cell."""

import math

from right_row import Row

FEWEST = 1000
"""Cells of a stratum, for its share to be known to about a point of percent."""


def rows(seed: int, cells: int) -> list[Row]:
    """The worst stratum of each error model: points of percent between a stated probability, 50 to 99 %, and how often
    the true height lay within; beside it the same of the paper's confidence level."""
    from confidence import coverage_table

    table = [row for row in coverage_table(seed, cells) if row.cells >= FEWEST]
    made = []
    for model in dict.fromkeys(row.stratum for row in table):
        own = [row for row in table if row.stratum == model]
        worst = max(own, key=lambda row: abs(row.covered - row.stated))
        paper = max(100.0 * abs(row.paper - row.stated) for row in own if not math.isnan(row.paper))
        note = (f"{len(own)} strata and levels; worst: {worst.points} points, {worst.scans} scans, {worst.pose_error}, "
                f"{worst.ground}: {worst.stated:.0%} stated, {worst.covered:.1%} held")  # fmt: skip
        off = 100.0 * abs(worst.covered - worst.stated)
        made.append(Row(f"simulated, {model}", "confidence off at most", "points", off, 3.0, before=paper, note=note))
    return made
