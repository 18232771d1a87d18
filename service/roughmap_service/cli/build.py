"""`roughmap build`: a map.db from recorded clouds, through the same integration as live, without a service."""

import json
import time
import uuid
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click

from roughmap_service.cli.options import BadUse, config_options, json_option, load

if TYPE_CHECKING:
    from roughmap import AddReport, RoughMap
    from roughmap_service.formats.clouds_in import PlacedPoints, RecordedScan
    from roughmap_service.run.settings import Settings


@click.command
@click.argument("clouds", nargs=-1, required=True, type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option(
    "-o", "--output", required=True, type=click.Path(dir_okay=False, path_type=Path), help="The map.db to write."
)
@click.option("--force", is_flag=True, help="Replace OUTPUT if it is there.")
@click.option("--sensor", default="lidar", show_default=True, help="Which [sensors.FRAME] gives scans their noise.")
@click.option(
    "--range-sigma",
    type=click.FloatRange(0, 10, min_open=True),
    help="Metres; in place of a configured sensor, its only noise.",
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
    """roughmap build points.xyz -o map.db

    Make a map from files, in the order given, and store it for `roughmap serve` (with `store.path`) to go on from.
    A file to try it with: `printf '%s\\n' '0 0 1.0' '0.1 0 1.1' '0.2 0 1.3' > points.xyz`.

    .npz holds `points` (N, 3), whole numbers being millimetres: either scans in the sensor's frame with
    `scan_start` (K + 1), `pose` (K, 4, 4, sensor in map) and `stamp_s` or `stamp_ns` (K); or points in the map frame,
    with `covariance` and `stamp_ns` if known.

    .xyz, .csv, .txt, .asc hold points in the map frame, one a line: the columns named x, y, z, else the first three.
    Points in the map frame without a covariance get `input.placed_sigma`.
    """
    from roughmap_schemas.config import configuration_digest
    from roughmap_service.run.settings import Settings, new_map
    from roughmap_service.store.map_db import Store

    config = load(config_path, settings).config
    if output.exists() and not force:
        raise BadUse(f"{output} is there already: choose another name, or --force to replace it")
    begun = time.monotonic()
    built = new_map(config)
    points, rejected = _fill(built, clouds, Settings(config), sensor, range_sigma)
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
    }
    if as_json:
        click.echo(json.dumps(report))
        return
    reasons = ", ".join(f"{count:,} {reason}" for reason, count in rejected.items())
    click.echo(
        f"{report['accepted']:,} of {points:,} points integrated" + (f"; rejected: {reasons}" if reasons else "")
    )
    if extent := built.extent():
        click.echo("tiles from x {:g} to {:g} m, y {:g} to {:g} m".format(*(extent[k] for k in (0, 2, 1, 3))))
    click.echo(f"{output}: {built.tile_count} tiles, digest {report['digest']}, in {seconds:.1f} s")


def _fill(
    built: "RoughMap", clouds: tuple[Path, ...], settings: "Settings", sensor: str, range_sigma: float | None
) -> tuple[int, dict[str, int]]:
    """Integrate all files; returns how many points they held, and the rejected by reason."""
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from roughmap_service.formats.clouds_in import read_cloud

    points = 0
    rejected: Counter[str] = Counter()
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("reading")
        for number, file in enumerate(clouds, 1):
            for part in read_cloud(file):
                report = _add(built, part, settings, sensor, range_sigma)
                points += len(part.points)
                rejected.update(report.rejected)
                where = f"file {number} of {len(clouds)}, {file.name}"
                progress.update(task, description=f"{where}: {points:,} points, {built.tile_count} tiles")
    return points, dict(rejected)


def _add(
    built: "RoughMap",
    part: "RecordedScan | PlacedPoints",
    settings: "Settings",
    sensor: str,
    range_sigma: float | None,
) -> "AddReport":
    import numpy as np

    from roughmap import Limits, Noise, Scan, Trajectory
    from roughmap_service.formats.clouds_in import PlacedPoints
    from roughmap_service.simulation.playing import rotation_of

    if isinstance(part, PlacedPoints):
        covariance = settings.placed_covariance if part.covariance is None else part.covariance
        return built.add(part.points, covariance, part.stamp_ns)
    if range_sigma is not None:
        noise, limits = Noise(range_sigma), Limits()
    else:
        configured = settings.sensor("", sensor)
        if configured is None:
            raise BadUse(f"no [sensors.{sensor}] is configured: give its file with -c, or --range-sigma METRES")
        noise, limits = configured.noise, configured.limits
    # The recorded pose is the sensor's own, so robot and sensor are one and the mounting is no part of it.
    trajectory = Trajectory(
        np.array([part.stamp_ns]), part.pose[None, :3, 3], rotation_of(part.pose)[None], settings.pose_covariance[None]
    )
    return built.add_scan(Scan(part.points, part.stamp_ns), trajectory, noise, limits)
