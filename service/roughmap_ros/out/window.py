"""The cells that a topic shows: a window that moves with a robot, cell by cell, or a fixed box."""

import math
from typing import NamedTuple

from roughmap_schemas.ros2_sections import Ros2OutConfig

SLACK = 1e-6
"""Part of a cell by which an edge may miss the border between two cells: 0.3 / 0.1 is less than 3."""


class Window(NamedTuple):
    """Cells of one level: ``nx`` columns from ``x`` on and ``ny`` rows from ``y`` on, of ``side`` metres.

    Column 0 begins at the map's x = 0, and row 0 at its y = 0.
    """

    x: int
    y: int
    nx: int
    ny: int
    side: float

    @property
    def asked(self) -> tuple[float, float, float, float]:
        """The box, metres, of a query for these cells and no others: its edges lie within the outer cells."""
        return (
            (self.x + 0.25) * self.side,
            (self.y + 0.25) * self.side,
            (self.x + self.nx - 0.25) * self.side,
            (self.y + self.ny - 0.25) * self.side,
        )

    @property
    def centre(self) -> tuple[float, float]:
        """The middle, metres in the map frame."""
        return (self.x + self.nx / 2) * self.side, (self.y + self.ny / 2) * self.side


def window(out: Ros2OutConfig, cell_size: float, position: tuple[float, float] | None) -> Window | None:
    """Return the window of a topic; None if it lies around a robot whose ``position`` (x, y in metres) isn't known."""
    side = cell_size * (1 << out.level)
    if out.box is not None:
        xmin, ymin, xmax, ymax = out.box
        x, y = math.floor(xmin / side + SLACK), math.floor(ymin / side + SLACK)
        nx, ny = math.ceil(xmax / side - SLACK) - x, math.ceil(ymax / side - SLACK) - y
        return Window(x, y, max(nx, 1), max(ny, 1), side)
    if position is None:
        return None
    nx, ny = (max(math.ceil(size / side - SLACK), 1) for size in out.size)
    x, y = (math.floor(at / side - n / 2 + 0.5) for at, n in zip(position, (nx, ny), strict=True))
    return Window(x, y, nx, ny, side)
