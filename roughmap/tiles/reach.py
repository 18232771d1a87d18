"""How far around a cell its ground is looked at: numbers of cells, from the side of a cell."""

LARGEST_FOOTPRINT, LARGEST_WINDOW = 6, 10
"""Cells; what a layer costs grows with their squares."""


def footprint(side: float) -> int:
    """Return the radius, in cells, of the ground that a cell's plane is fitted to: 0.3 m, at least 1.5 cells."""
    return min(_nearest(max(0.3, 1.5 * side) / side), LARGEST_FOOTPRINT)


def window(side: float) -> int:
    """Return the radius, in cells, of the square in which a ground must not hang over another: 0.5 m, at least 2."""
    return min(_nearest(max(0.5, 2.0 * side) / side), LARGEST_WINDOW)


def ring(side: float) -> int:
    """Return how many cells around a tile its layers depend on; the last one is for the support of the others."""
    return footprint(side) + window(side) + 1


def _nearest(cells: float) -> int:
    """Round half to even, after the rounding of the quotient: 1.5 * 0.35 / 0.35 is 1.4999999999999998."""
    return round(round(cells, 9))
