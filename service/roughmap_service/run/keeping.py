"""Which tiles the map no longer keeps: those far from all robots, and those without a new point for long."""

import math
from collections.abc import Iterable, Iterator

import numpy as np
import numpy.typing as npt

from roughmap.arrays import I4, I8
from roughmap.cell import TILE_CELLS
from roughmap_service.run.robot import Robot
from roughmap_service.run.settings import NS, Settings

INTERVAL_NS = 5 * NS
"""Time between two looks, by the stamps of the points."""

MOST_TILES = 1 << 16
"""Tiles of one event: about a megabyte of JSON."""


class Keeping:
    """Tells from time to time which tiles to forget; live only, since a replay forgets what the events name."""

    def __init__(self) -> None:
        self._looked_ns = -INTERVAL_NS

    def due(self, settings: Settings, newest_ns: int) -> bool:
        """Return whether to look for such tiles, at the newest stamp of the map's points; if so, count from there."""
        if not settings.forgets or 0 <= newest_ns - self._looked_ns < INTERVAL_NS:
            return False
        self._looked_ns = newest_ns
        return True


def present_ns(robots: Iterable[Robot], newest_ns: int) -> int:
    """Return the time from which ages count: the newest stamp of points, but not after the newest pose of any robot.

    Clouds that come placed have stamps of their own, which no pose confirms: one wrong one must not age the map.
    """
    return min(
        newest_ns, max((robot.buffer.poses[-1].stamp_ns for robot in robots if robot.buffer.poses), default=newest_ns)
    )


def not_kept(
    tiles: I4, stamps_ns: I8, robots: Iterable[Robot], settings: Settings, now_ns: int
) -> npt.NDArray[np.bool_]:
    """Return which of (T, 2) tiles, each with its newest stamp, `map.keep` does not keep.

    All of them is farther from the newest pose of every robot than the radius, or their newest point is older than the
    age. So the ground within the radius stays, that under a robot always. Robots without a pose don't count; if none
    has one, no tile is far.
    """
    side = TILE_CELLS * settings.config.map.cell_size
    far = np.zeros(len(tiles), np.bool_)
    places = [robot.buffer.poses[-1].position for robot in robots if robot.buffer.poses]
    if places and math.isfinite(settings.keep_radius):
        far[:] = True
        for x, y, _ in places:
            along_x, along_y = _beyond(tiles[:, 0], side, x), _beyond(tiles[:, 1], side, y)
            far &= np.sqrt(along_x * along_x + along_y * along_y) > settings.keep_radius
    old = stamps_ns < now_ns - settings.keep_age_ns
    return far | old


def _beyond(number: I4, side: float, place: float) -> npt.NDArray[np.float64]:
    """Return how far tiles are from a place along one axis, 0 for those that reach over it."""
    beyond: npt.NDArray[np.float64] = np.maximum(np.abs((number + 0.5) * side - place) - 0.5 * side, 0.0)
    return beyond


def pieces(tiles: I4) -> Iterator[I4]:
    """Cut (T, 2) tiles into as many as one event may name."""
    for start in range(0, len(tiles), MOST_TILES):
        yield tiles[start : start + MOST_TILES]
