"""A cloud's points placed in the map frame, and the span of their times."""

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace

import numpy as np

from roughmap import Prepared, RoughMap, Scan
from roughmap.cell import OFFSET_LIMIT_NS, STAMP_LIMIT_NS
from roughmap.tiles.table import ReaderLock
from roughmap_schemas import Cloud, PointReason
from roughmap_service.run.mountings import Mounting
from roughmap_service.run.poses import Pose, trajectory
from roughmap_service.run.returns import repeated_returns
from roughmap_service.run.settings import Settings


def place_cloud(
    rough_map: RoughMap,
    robot: str,
    cloud: Cloud,
    poses: Sequence[Pose],
    settings: Settings,
    *,
    mounting: Mounting | None = None,
    clear: bool = False,
    no_new_tiles: bool = False,
    reader_lock: ReaderLock = nullcontext,
) -> Prepared:
    """Place a cloud's points (eq. 1) and bring the tiles they touch into memory; the map does not change yet.

    ``mounting``: where the sensor is, None for what is configured. With ``clear`` a scan also clears what it sees
    through, unless none of its points is accepted.
    Raises TooManyTiles if the cloud needs more new tiles than it may have (none with ``no_new_tiles``), NoTrajectory
    for ``poses`` that are not one. ``reader_lock`` as for `RoughMap.prepare_points`.
    """
    most_new, most = 0 if no_new_tiles else settings.max_new_tiles, settings.max_tiles
    if cloud.frame_id == settings.frame_id:  # placed already: no pose, no sensor limits, one covariance for all points
        return rough_map.prepare_points(
            cloud.points, settings.placed_covariance, cloud.stamp_ns, offsets_ns=cloud.offsets_ns,
            common=settings.placed_variance, pose_error_time=settings.pose_error_time(robot),
            max_new_tiles=most_new, max_tiles=most, reader_lock=reader_lock,
        )  # fmt: skip
    sensor = settings.sensor(robot, cloud.frame_id)
    if sensor is None:  # the cloud waited over a restart, and the new configuration lacks its sensor
        return Prepared(0, {PointReason.NO_POSE: len(cloud.points)} if len(cloud.points) else {})
    points, offsets = cloud.points, cloud.offsets_ns
    repeated = repeated_returns(points) if settings.rules > 1 else None
    if repeated is not None:
        points = points[~repeated]
        offsets = None if offsets is None else offsets[~repeated]
    scan = Scan(
        points,
        cloud.stamp_ns,
        offsets_ns=offsets,
        translation=(sensor if mounting is None else mounting).translation,
        rotation=(sensor if mounting is None else mounting).rotation,
    )
    path = trajectory(poses, settings.pose_covariance)
    prepared = rough_map.prepare_scan(
        scan, path, sensor.noise, sensor.limits,
        clear=clear, max_new_tiles=most_new, max_tiles=most, reader_lock=reader_lock,
    )  # fmt: skip
    if repeated is not None:
        rejected = prepared.rejected | {PointReason.DUPLICATE_RETURN: int(np.count_nonzero(repeated))}
        prepared = replace(prepared, rejected=rejected)
    return prepared


def span(cloud: Cloud) -> tuple[int, int]:
    """Return the first and last time of a cloud's points in ns.

    Points whose own time is out of range don't count. If none is left, both are the cloud's stamp.
    """
    if cloud.offsets_ns is None or not len(cloud.offsets_ns):
        return cloud.stamp_ns, cloud.stamp_ns
    offsets = cloud.offsets_ns
    last = min(OFFSET_LIMIT_NS, STAMP_LIMIT_NS - 1 - cloud.stamp_ns)
    if int(offsets.min()) < 0 or int(offsets.max()) > last:
        offsets = offsets[(offsets >= 0) & (offsets <= last)]
        if not len(offsets):
            return cloud.stamp_ns, cloud.stamp_ns
    return cloud.stamp_ns + int(offsets.min()), cloud.stamp_ns + int(offsets.max())
