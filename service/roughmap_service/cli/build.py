"""`roughmap build`: make a map.db from recorded clouds, integrated as a service would."""

import json
import time
import uuid
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click

from roughmap_service.cli.figures import metres
from roughmap_service.cli.options import BadUse, config_options, json_option, load
from roughmap_service.host.log_lines import printable

if TYPE_CHECKING:
    from roughmap import AddReport, RoughMap
    from roughmap_service.formats.recorded import PlacedPoints, RecordedScan
    from roughmap_service.run.sensor_clock import SensorClock
    from roughmap_service.run.settings import Settings


@click.command
@click.argument("clouds", nargs=-1, required=True, type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option(
    "-o", "--output", required=True, type=click.Path(dir_okay=False, path_type=Path), help="The map.db to write."
)
@click.option("--force", is_flag=True, help="Replace an existing OUTPUT.")
@click.option(
    "--sensor",
    default="lidar",
    show_default=True,
    help="Sensor of the scans: the FRAME of a configured [sensors.FRAME].",
)
@click.option(
    "--range-sigma",
    type=click.FloatRange(0, 10, min_open=True),
    help="Range noise in metres, for scans of a sensor that is not configured.",
)
@config_options
@json_option
def build(
    clouds: tuple[Path, ...],
    output: Path,
    force: bool,
    sensor: str,
    range_sigma: float | None,
    config_path: Path | None,
    settings: tuple[tuple[str, object], ...],
    as_json: bool,
) -> None:
    """echo '0 0 1.5' > points.xyz && roughmap build points.xyz -o map.db

    Make a map from recorded clouds, in the order given. `roughmap serve` continues from it if `store.path` names it.

    \b
    .xyz .csv .txt .asc   points in the map frame, one per line, in metres: the columns
                          that a header names (x, y, z or Easting, Northing, Elevation),
                          or the first three
    .npz, placed points   `points` (N, 3) in the map frame, in metres, or in millimetres
                          if integer; optional: `stamp_ns` (1 or N) and `covariance`
                          (3, 3) or (N, 3, 3)
    .npz, K scans         `points` as above, but in the sensor's frame; `scan_start`
                          (K + 1): scan k is points[scan_start[k]:scan_start[k + 1]];
                          `pose` (K, 4, 4): the sensor in the map frame; optional:
                          `stamp_s` or `stamp_ns` (K)

    Points in the map frame without a covariance get `input.placed_sigma`; those whose height stands for "no data", such
    as -9999, are counted as `no_data` and left out. What can't be read, or could be read in two ways, ends the command
    with the number of the line or pose, and no map is written.
    """
    from roughmap_schemas.config import configuration_digest
    from roughmap_service.run.settings import Settings, new_map
    from roughmap_service.store.map_db import Store

    config = load(config_path, settings).config
    if output.exists() and not force:
        raise BadUse(f"{output} exists; choose another name, or use --force to replace it")
    begun = time.monotonic()
    built = new_map(config)
    points, rejected, warnings = _fill(built, clouds, Settings(config), sensor, range_sigma)
    for warning in warnings:
        click.echo(f"roughmap: warning: {printable(warning)}", err=True)
    for stale in (output, *(output.with_name(output.name + end) for end in ("-wal", "-shm"))):
        stale.unlink(missing_ok=True)
    Store(output).write_map(built, config.public_dict(), configuration_digest(config), uuid.uuid4().hex)
    seconds = time.monotonic() - begun
    report = {
        "output": str(output),
        "points": points,
        "accepted": points - sum(rejected.values()),
        "rejected": rejected,
        "tiles": built.tile_count,
        "extent": built.extent(),
        "sequence": built.sequence,
        "digest": built.digest(),
        "seconds": seconds,
        "warnings": warnings,
    }
    if as_json:
        click.echo(json.dumps(report))
        return
    reasons = ", ".join(f"{count:,} {reason}" for reason, count in rejected.items())
    click.echo(
        f"{report['accepted']:,} of {points:,} points integrated" + (f"; rejected: {reasons}" if reasons else "")
    )
    if extent := built.extent():
        xmin, ymin, xmax, ymax = map(metres, extent)
        click.echo(f"tiles from x {xmin} to {xmax} m, y {ymin} to {ymax} m")
    tiles = f"{built.tile_count} {'tile' if built.tile_count == 1 else 'tiles'}"
    click.echo(f"{output}: {tiles}, digest {report['digest']}, in {seconds:.1f} s")


def _fill(
    built: "RoughMap", clouds: tuple[Path, ...], settings: "Settings", sensor: str, range_sigma: float | None
) -> tuple[int, dict[str, int], list[str]]:
    """Integrate all files; return the number of points, the rejected ones by reason, and warnings."""
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from roughmap_service.formats.clouds import read_cloud
    from roughmap_service.formats.doubts import Doubts, without_no_data
    from roughmap_service.formats.recorded import PlacedPoints
    from roughmap_service.run.sensor_clock import SensorClock

    points, clock = 0, SensorClock()
    warnings: list[str] = []
    rejected: Counter[str] = Counter()
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("reading")
        for number, file in enumerate(clouds, 1):
            doubts = Doubts()
            for read in read_cloud(file):
                part = without_no_data(read) if isinstance(read, PlacedPoints) else read
                doubts.take(part.points if isinstance(part, PlacedPoints) else part.position[None])
                points += len(read.points)
                rejected.update({"no_data": missing} if (missing := len(read.points) - len(part.points)) else {})
                if len(part.points) or not missing:
                    rejected.update(_add(built, part, settings, sensor, range_sigma, clock).rejected)
                where = f"file {number} of {len(clouds)}, {file.name}"
                progress.update(task, description=f"{where}: {points:,} points, {built.tile_count} tiles")
            warnings += (f"{file}: {doubt}" for doubt in doubts.found(built.cell_size))
    return points, dict(rejected), warnings


def _add(
    built: "RoughMap",
    part: "RecordedScan | PlacedPoints",
    settings: "Settings",
    sensor: str,
    range_sigma: float | None,
    clock: "SensorClock",
) -> "AddReport":
    import numpy as np

    from roughmap import Limits, Noise, Scan, Trajectory
    from roughmap_service.formats.recorded import PlacedPoints

    if isinstance(part, PlacedPoints):
        covariance = settings.placed_covariance if part.covariance is None else part.covariance
        # How much of a point's error it shares with others is not in the file: all of it, to be safe.
        shared = np.nan_to_num(np.asarray(covariance)[..., 2, 2], nan=0.0, posinf=0.0)
        return built.add(part.points, covariance, part.stamp_ns, common=shared)
    if range_sigma is not None:
        noise, limits = Noise(range_sigma), Limits()
    else:
        configured = settings.sensor("", sensor)
        if configured is None:
            raise BadUse(
                f"[sensors.{sensor}] is not configured: add it to the configuration, or use --range-sigma METRES"
            )
        noise, limits = configured.noise, configured.limits
    # The recorded pose is the sensor's, so the sensor's place on the robot does not matter.
    trajectory = Trajectory(
        np.array([part.stamp_ns]), part.position[None], part.rotation[None], settings.pose_covariance[None]
    )
    clear = settings.clears and clock.clears(part.stamp_ns, settings.clear_interval_ns)
    report = built.add_scan(Scan(part.points, part.stamp_ns), trajectory, noise, limits, clear=clear)
    if clear and report.accepted:
        clock.cleared_ns = part.stamp_ns
    return report
