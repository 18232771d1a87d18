"""Judges a sensor's clouds: its frame, what its points are like, and whether the map has room for them."""

import math

import numpy as np

from roughmap.cell import TILE_CELLS
from roughmap_schemas import SensorConfig
from roughmap_schemas.config import Config
from roughmap_schemas.geometry import rotation_matrix
from roughmap_service.cli.doctor.findings import Finding, table
from roughmap_service.cli.doctor.heard import HeardSensor, HeardTransform
from roughmap_service.cli.doctor.survey import Survey

NO_RANGE = 1_000.0
"""Metres. A usual point is nearer: such coordinates have another unit."""

EXCLUDED = 0.9
"""Share of a sensor's points within its ``exclude`` boxes that can't be meant."""

ROOM = 2
"""Margin between the tiles that the points of a cloud fall into and those that their error bodies touch."""


def judge_frame(robot: str, frame: str, config: Config, mounting: HeardTransform | None = None) -> list[Finding]:
    """Judge whether the service takes clouds in this frame; ``mounting``: where a transform says that it is mounted."""
    if frame == config.map.frame_id or config.sensor(robot, frame) is not None:
        return []
    text = f"clouds in frame {frame!r} are refused: it is neither the map's frame nor a configured sensor"
    if not frame:
        return [Finding(robot, "wrong", "clouds without a frame_id are refused", "let the driver fill it in")]
    own = config.robots.get(robot)
    known = {config.map.frame_id, *config.sensors, *(own.sensors if own is not None else ())}
    alike = sorted(name for name in known if name.strip("/") == frame.strip("/"))
    if alike:
        return [
            Finding(robot, "wrong", f"{text}; {alike[0]!r} is one", "use one name, without or with the leading slash")
        ]
    remedy = "describe the sensor, with its own values, or correct the clouds' frame_id:"
    settings = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "range_sigma": 0.03}
    if mounting is not None:
        settings = {"extrinsics": "transform", "range_sigma": 0.03}
    return [Finding(robot, "wrong", text, remedy, table(("sensors", frame), settings))]


def judge_mounting(
    robot: str, frame: str, config: Config, mounting: HeardTransform | None, *, mounted: bool
) -> list[Finding]:
    """Judge whether it is known where a sensor is mounted whose mounting comes with the robot's transforms.

    ``mounting`` is what came meanwhile; ``mounted``: the running service knows it from before.
    """
    settings = config.sensor(robot, frame)
    if settings is None or settings.extrinsics != "transform":
        return []
    if mounting is not None:
        at = ", ".join(f"{value:.4g}" for value in mounting.translation)
        return [Finding(robot, "ok", f"mounting of {frame!r}: {mounting.parent} -> {frame} at {at} m, by transform")]
    if mounted:
        return [Finding(robot, "ok", f"mounting of {frame!r}: the service knows it, by an earlier transform")]
    text = f"{frame!r} waits for the transform base -> {frame} (extrinsics): none came meanwhile; without one, its "
    text += "clouds are rejected as no_extrinsics"
    key = config.keys["transform"].replace("{robot}", robot)
    remedy = f"publish it on {key} while the service runs, or set translation and rotation instead"
    return [Finding(robot, "note", text, remedy)]


def judge_points(
    robot: str,
    frame: str,
    sensor: HeardSensor,
    config: Config,
    table_names: tuple[str, ...],
    mounting: HeardTransform | None = None,
) -> list[Finding]:
    """Judge the points of a sensor's clouds, by the surveys of some of them; ``mounting``: as for `judge_frame`."""
    surveys = [one for one in sensor.surveys if one.points]
    where = f"clouds in {frame!r}"
    if not surveys:
        return [Finding(robot, "wrong", f"{where} have no points", "look at the driver")] if sensor.surveys else []
    returns = sum(one.returns for one in surveys)
    if not returns:
        text = f"all points in {where} are NaN or (0, 0, 0): nothing came back"
        return [Finding(robot, "wrong", text, "look at the scanner: is it covered, or not turning?")]
    findings = []
    equal = max(surveys, key=lambda one: one.equal)
    if equal.equal:
        at = ", ".join(f"{value:.3g}" for value in equal.equal_at)
        text = f"{equal.equal:,} of {equal.points:,} points of a cloud in {frame!r} are equal, ({at}): no returns, "
        text += "moved off zero"
        remedy = "let the driver send (0, 0, 0) or NaN where nothing came back; these are rejected as duplicate_return"
        findings.append(Finding(robot, "note", text, remedy))
    settings = config.sensor(robot, frame)
    if settings is None:
        return findings
    ranges = np.array([one.ranges for one in surveys])
    median = float(np.median(ranges[:, 1]))
    if median > NO_RANGE:
        text = f"points in {where} are {median:,.0f} m away (median)"
        return [*findings, Finding(robot, "wrong", text, "send coordinates in metres, in the sensor's frame")]
    if ranges[:, 3].max() < settings.min_range or ranges[:, 0].min() > settings.max_range:
        name, value = (
            ("min_range", settings.min_range) if median < settings.max_range else ("max_range", settings.max_range)
        )
        text = f"points in {where} are {median:.2f} m away (median); {name} = {value:g} rejects all of them"
        findings.append(Finding(robot, "wrong", text, f"correct {name} in [{'.'.join(table_names)}]"))
    if settings.extrinsics == "configured":
        findings += _excluded(robot, frame, surveys, settings, settings, table_names)
    elif mounting is not None:
        findings += _excluded(robot, frame, surveys, settings, mounting, table_names)
    return findings + _room(robot, frame, surveys, config, settings.max_range, table_names)


def _excluded(
    robot: str,
    frame: str,
    surveys: list[Survey],
    settings: SensorConfig,
    mounting: SensorConfig | HeardTransform,
    table_names: tuple[str, ...],
) -> list[Finding]:
    """Judge whether the sensor's ``exclude`` boxes, in the robot's frame, hold nearly all of its points."""
    if not settings.exclude:
        return []
    turn = np.array(rotation_matrix(mounting.rotation))
    points = np.concatenate([one.some for one in surveys]) @ turn.T + np.array(mounting.translation)
    inside = np.zeros(len(points), np.bool_)
    for box in np.array(settings.exclude):
        inside |= ((points >= box[:3]) & (points <= box[3:])).all(axis=1)
    share = float(inside.mean())
    if share < EXCLUDED:
        return []
    text = f"{100.0 * share:.0f} % of the points in clouds in {frame!r} lie in the boxes of exclude: they are rejected"
    remedy = f"correct exclude in [{'.'.join(table_names)}]: its boxes are in the robot's frame, for the robot itself"
    return [Finding(robot, "wrong", text, remedy)]


def _room(
    robot: str, frame: str, surveys: list[Survey], config: Config, max_range: float, table_names: tuple[str, ...]
) -> list[Finding]:
    """Judge whether one cloud needs more tiles than it may have."""
    most = min(config.map.max_new_tiles, config.map.max_tiles)
    needed = max(one.tiles(max_range) for one in surveys)
    if needed <= most:
        return []
    cell, side = config.map.cell_size, config.map.cell_size * TILE_CELLS
    reach = min(max_range, max(float(one.tile_ranges[-1]) for one in surveys))
    text = (
        f"a cloud in {frame!r} reaches {reach:.0f} m and touches {needed:,} tiles of {side:g} m, "
        f"map.max_new_tiles = {config.map.max_new_tiles:,}: it is rejected (too_many_tiles)"
    )
    fits = min(float(one.tile_ranges[min(most // ROOM, len(one.tile_ranges) - 1)]) for one in surveys)
    remedy = f"raise map.cell_size ({cell:g} m) or map.max_new_tiles (up to 592 KiB each), or limit the range:"
    return [Finding(robot, "wrong", text, remedy, table(table_names, {"max_range": max(math.floor(fits), 1.0)}))]
