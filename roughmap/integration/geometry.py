"""The points of a call, checked and made ready for the kernels of phase one."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roughmap.arrays import F8, I8, Flags
from roughmap.cell import OFFSET_LIMIT_NS, STAMP_LIMIT_NS, PointReason
from roughmap.integration.blocks import BlockState, point_blocks, scan_blocks
from roughmap.integration.clearing import Look
from roughmap.integration.workspace import Block, Planes, TouchedTiles, Workspace
from roughmap.points.checks import (
    checked_covariances,
    checked_each,
    checked_integers,
    checked_points,
    checked_stamps,
    checked_time,
)
from roughmap.points.place import pose_at
from roughmap.points.scan import Limits, Noise, Scan, scan_rules
from roughmap.points.strided import source_of
from roughmap.points.trajectory import Trajectory
from roughmap.settings import MapSettings

Geometry = Callable[[int, int, Block, TouchedTiles, BlockState], tuple[int, BlockState]]
"""Phase one over a range of points: (start, stop, scratch, tiles, state before) to (where it stopped, state there)."""


class PointInput(NamedTuple):
    """A call's points: the array itself, their planes, their stamps ((1,) for all, or (N,)), and their geometry; the
    seconds over which the errors of their poses stay alike; the scan, if it clears."""

    points: npt.NDArray[np.floating]
    """Kept here because ``geometry`` reads the array by address."""
    planes: Planes
    stamps: I8
    geometry: Geometry
    pose_error_time: float
    look: Look | None = None


class Shared(NamedTuple):
    """What the errors of placed points have in common; see `RoughMap.add`."""

    common: npt.ArrayLike | None
    mount: npt.ArrayLike | None
    up: npt.ArrayLike | None
    pose_error_time: float

    def checked(self, number: int) -> tuple[F8, F8, Flags]:
        """Return common, mount and up as (1,) or (N,) arrays; ValueError unless all are right."""
        checked_time("pose_error_time", self.pose_error_time)
        common, mount = (
            checked_each(0.0 if value is None else value, number, "fiu", name)
            for value, name in ((self.common, "common"), (self.mount, "mount"))
        )
        return common, mount, checked_each(False if self.up is None else self.up, number, "b", "up")


def placed_points(
    points: npt.ArrayLike,
    covariance: npt.ArrayLike | None,
    stamp_ns: npt.ArrayLike,
    offsets_ns: npt.ArrayLike | None,
    shared: Shared,
    settings: MapSettings,
    space: Workspace,
) -> PointInput:
    """Check points that lie in the map frame; see `RoughMap.add`. A point whose offset is out of range is rejected."""
    checked = checked_points(points, "points")
    number = len(checked)
    matrices = checked_covariances(covariance, number, settings.error_model)
    stamps = checked_stamps(stamp_ns, number)
    errors = shared.checked(number)
    late = None
    if offsets_ns is not None:
        offsets = checked_integers(offsets_ns, (number,), "offsets_ns")
        late = (offsets < 0) | (offsets > OFFSET_LIMIT_NS)
        stamps = stamps + np.where(late, 0, offsets)
        late |= stamps >= STAMP_LIMIT_NS
    planes = space.planes(number)
    if late is not None:
        planes.reason[:number][late & np.isfinite(checked).all(axis=1)] = PointReason.TIME
    source, rules = source_of(checked), settings.rules

    def bound(start: int, stop: int, block: Block, tiles: TouchedTiles, state: BlockState) -> tuple[int, BlockState]:
        return point_blocks(start, stop, planes, block, source, matrices, errors, rules, tiles.arrays, state)

    return PointInput(checked, planes, stamps, bound, shared.pose_error_time)


def scan_points(
    scan: Scan,
    trajectory: Trajectory,
    noise: Noise,
    limits: Limits,
    clear: bool,
    settings: MapSettings,
    space: Workspace,
) -> PointInput:
    """Take the points of a scan, which phase one places in the map frame; see `RoughMap.add_scan`."""
    number = len(scan.points)
    offsets = scan.times
    stamps = scan.stamp_ns + (np.zeros(1, np.int64) if scan.offsets_ns is None else offsets)
    clear = clear and settings.ground_only  # nothing else has columns
    path, gap, returns = trajectory.arrays, limits.max_gap_ns, scan_rules(scan, noise, limits)
    posed, pose = pose_at(path, gap, scan.stamp_ns)
    planes = space.planes(number)
    source, rules = source_of(scan.points), settings.rules

    def place(start: int, stop: int, block: Block, tiles: TouchedTiles, state: BlockState) -> tuple[int, BlockState]:
        return scan_blocks(
            start, stop, planes, block, source, offsets, scan.offsets_ns is not None, scan.stamp_ns, path,
            gap, posed, pose, returns, rules, clear, tiles.arrays, state,
        )  # fmt: skip

    look = Look(scan, trajectory, limits) if clear else None
    return PointInput(scan.points, planes, stamps, place, noise.pose_error_time, look)
