"""`roughmap build`: make a map.db from recordings, integrated as a service would."""

import json
import sqlite3
import threading
import time
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from roughmap_service.cli.figures import metres
from roughmap_service.cli.options import BadUse, Failure, config_options, json_option, load
from roughmap_service.cli.reading import only_robot, read_options, reading_options
from roughmap_service.host.log_lines import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from roughmap import RoughMap
    from roughmap_service.offline.building import Built, Watch
    from roughmap_service.offline.building import Progress as Far


@click.command
@click.argument("recordings", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
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
@click.option("--robot", help="Robot that the recordings are of. [default: the only one in ros2.robots]")
@reading_options
@config_options
@json_option
def build(
    recordings: tuple[Path, ...],
    output: Path,
    force: bool,
    sensor: str,
    range_sigma: float | None,
    robot: str | None,
    config_path: Path | None,
    settings: tuple[tuple[str, object], ...],
    as_json: bool,
    **reading: object,
) -> None:
    """echo '0 0 1.5' > points.xyz && roughmap build points.xyz -o map.db

    Make a map from recordings, in the order given. `roughmap serve` continues from it if `store.path` names it.

    \b
    bags of ROS           rosbag2 folders, .mcap, .db3, and .bag of ROS 1: clouds, odometry
                          and tf are found by their types, and mapped as a service would
    .mcap                 also of Foxglove's messages, and roughmap's own logs
    .las .laz             surveyed points in the map frame, or by gps_time with --scan-seconds;
                          noise and withheld points are left out
    .ply .pcd             points in the map frame; a PCD's VIEWPOINT is the pose of a scan
    folders of scans      of KITTI (velodyne, poses.txt, calib.txt), or of .ply, .pcd, .npz
                          and .xyz files with --poses; a name that is a stamp finds the pose
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
    with the number of the line or pose, and no map is written. Ctrl-C writes the map of what was read so far.

    `roughmap build my_bag -o map.db --range-sigma 0.03` maps a bag without a configuration: its sensors are where tf
    says. Poses in a frame without a way to `map.frame_id` are mapped in their own.
    """
    from roughmap_schemas.config import configuration_digest
    from roughmap_service.exports.whole import whole
    from roughmap_service.offline.building import Wanted, build_map
    from roughmap_service.store.map_db import Store

    config = load(config_path, settings).config
    _check_suffix(output)
    if output.exists() and not force:
        raise BadUse(f"{output} exists; choose another name, or use --force to replace it")
    begun = time.monotonic()
    name = only_robot(config, robot)
    options = read_options(config, name, reading, any_sensor=range_sigma is not None)
    wanted, stop = Wanted(name, sensor, range_sigma), threading.Event()
    crs = _crs(recordings)
    built = _watched(stop, lambda watch: build_map(recordings, config, options, wanted, watch, stop))
    for warning in built.warnings:
        click.echo(f"roughmap: warning: {printable(warning)}", err=True)
    if not (built.map.tile_count or built.warnings or built.interrupted):
        click.echo("roughmap: warning: the map is empty: nothing of what was read could be integrated", err=True)
    settled = built.config
    try:
        output.absolute().parent.mkdir(parents=True, exist_ok=True)
        with whole(output) as file:
            Store(file).write_map(
                built.map, settled.public_dict(), configuration_digest(settled), uuid.uuid4().hex, crs
            )
            for end in ("-wal", "-shm"):  # of the map.db that is replaced
                output.with_name(output.name + end).unlink(missing_ok=True)
    except (OSError, sqlite3.Error) as error:
        raise Failure(f"{output}: {getattr(error, 'strerror', None) or error}; it was not written") from None
    extent = built.map.extent()
    report = {
        "output": str(output),
        "points": built.points,
        "accepted": built.accepted,
        "rejected": dict(built.rejected),
        "clouds": dict(built.clouds),
        "poses": dict(built.poses),
        "refused": dict(built.refused),
        "tiles": built.map.tile_count,
        "extent": extent,
        "sequence": built.map.sequence,
        "digest": built.map.digest(),
        "seconds": time.monotonic() - begun,
        "interrupted": built.interrupted,
        "warnings": built.warnings,
    }
    if as_json:
        click.echo(json.dumps(report))
    else:
        _print(report, extent)
    if built.interrupted:
        click.echo(f"roughmap: interrupted; {output} holds what was read until then", err=True)
        click.get_current_context().exit(130)


def _check_suffix(output: Path) -> None:
    """Raise BadUse for a suffix that a map.db does not have: of a recording, or of what `roughmap export` writes."""
    kind = output.suffix.lower()
    if kind in {"", ".db"}:  # nearly always; the others' writers take a second to import
        return
    from roughmap_service.exports.files import formats
    from roughmap_service.formats.clouds import READERS

    exported = kind in formats(1.0)
    if exported or kind in READERS:
        then = f"; then `roughmap export` writes {kind} of it" if exported else ""
        raise BadUse(f"{output}: build makes a map.db: -o {output.with_suffix('.db')}{then}")


def _crs(recordings: tuple[Path, ...]) -> str | None:
    """Return the coordinate reference system of all recordings that state one; BadUse if they state different ones."""
    from roughmap_service.formats.crs import crs_of

    found = {crs: path for path in recordings if (crs := crs_of(path)) is not None}
    if len(found) > 1:
        paths = " and ".join(str(path) for path in list(found.values())[:2])
        raise BadUse(f"{paths} are in different coordinate reference systems; project them to one")
    return next(iter(found), None)


def _watched(stop: threading.Event, build: "Callable[[Watch], Built]") -> "Built":
    """Build with a line that shows the progress, on a terminal; Ctrl-C sets `stop`."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from roughmap_service.offline.building import interrupting

    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn(elapsed_when_finished=True))
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("reading", total=1.0)

        def watch(far: "Far", rough_map: "RoughMap") -> None:
            where = f"file {far.number}, {far.name}: {far.points:,} points, {far.rate / 1e6:.1f} million/s"
            progress.update(task, completed=far.share, description=f"{where}, {rough_map.tile_count} tiles")

        with interrupting(stop):
            return build(watch)


def _counted(counts: "Mapping[str, int]", first: str) -> str:
    """Return the counts by reason without the one named `first`, largest first."""
    others = sorted(((number, reason) for reason, number in counts.items() if reason != first), reverse=True)
    return ", ".join(f"{number:,} {reason}" for number, reason in others)


def _print(report: dict[str, Any], extent: tuple[float, float, float, float] | None) -> None:
    reasons = ", ".join(f"{count:,} {reason}" for reason, count in report["rejected"].items())
    click.echo(
        f"{report['accepted']:,} of {report['points']:,} points integrated"
        + (f"; rejected: {reasons}" if reasons else "")
    )
    for what, first, done in (("clouds", "integrated", "integrated"), ("poses", "taken", "taken")):
        if counts := report[what]:
            lost = _counted(counts, first)
            line = f"{counts.get(first, 0):,} of {sum(counts.values()):,} {what} {done}"
            click.echo(line + (f"; rejected: {lost}" if lost else ""))
    if refused := _counted(report["refused"], ""):
        click.echo(f"messages refused: {refused}")
    if extent is not None:
        xmin, ymin, xmax, ymax = map(metres, extent)
        click.echo(f"tiles from x {xmin} to {xmax} m, y {ymin} to {ymax} m")
    tiles = f"{report['tiles']} {'tile' if report['tiles'] == 1 else 'tiles'}"
    click.echo(f"{report['output']}: {tiles}, digest {report['digest']}, in {report['seconds']:.1f} s")
