"""`roughmap export`: write the map for other tools: GIS, point cloud viewers, Nav2, RViz."""

import json
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from roughmap_service.cli.options import (
    BadUse,
    Failure,
    bounding_box,
    config_options,
    connect_option,
    json_option,
    load,
    zenoh_option,
)

if TYPE_CHECKING:
    import zenoh
    from rich.progress import Progress

    from roughmap_service.exports.sheet import Sheet


@click.command
@click.argument("sources", nargs=-1, type=click.Path(exists=True, path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="The file to write.")
@click.option("--force", is_flag=True, help="Replace an existing OUTPUT.")
@click.option("--layers", help="Layers, separated by commas. [default: by the format]")
@click.option(
    "--level",
    type=click.IntRange(0, 24),
    default=0,
    show_default=True,
    help="Level; 0 is the finest, and each level doubles the cell size.",
)
@click.option("--bbox", type=bounding_box, metavar="XMIN,YMIN,XMAX,YMAX", help="Only this part, metres.")
@click.option("--crs", help="Coordinate reference system of x and y, such as EPSG:32633. [default: the input's]")
@click.option(
    "--threshold",
    type=click.FloatRange(0, 1, min_open=True),
    default=0.5,
    show_default=True,
    help="For Nav2: least traversability of a free cell.",
)
@connect_option
@zenoh_option
@config_options
@json_option
def export(
    sources: tuple[Path, ...],
    output: Path,
    force: bool,
    layers: str | None,
    level: int,
    bbox: tuple[float, float, float, float] | None,
    crs: str | None,
    threshold: float,
    connect: tuple[str, ...],
    zenoh_file: Path | None,
    config_path: Path | None,
    settings: tuple[tuple[str, object], ...],
    as_json: bool,
) -> None:
    """roughmap export map.db -o ground.npz

    Write a map for other tools. The map is a map.db, the log of a run, or, without either, that of a running service.

    \b
    .tif        cloud-optimised GeoTIFF, a band a layer (QGIS, GDAL)     needs roughmap[geo]
    .npz        the layers as numpy arrays, row 0 at the lowest y
    .asc        ESRI ASCII grid, one layer
    .png        picture with world file, one layer
    .yaml       map for Nav2's map_server, with its .pgm
    no suffix   folder with a rosbag2 of one grid_map_msgs/GridMap (RViz)
    .ply .pcd   the cells as points (CloudCompare, PCL)
    .las .laz   the cells as points, with layers and CRS                 needs roughmap[las]

    Unknown cells are NaN, or what stands for no data in the format.
    """
    from roughmap_schemas.layers import LAYERS
    from roughmap_service.cli.connection import client_config
    from roughmap_service.exports.files import formats
    from roughmap_service.exports.whole import whole

    known = formats(threshold)
    suffix = output.suffix.lower()
    if suffix not in known:
        raise BadUse(f"{output}: unknown format {suffix!r} (allowed: {', '.join(filter(None, known))}, or no suffix)")
    for place in (output, *(output.with_suffix(end) for end in known[suffix].beside)):
        if place.exists() and not force:
            raise BadUse(f"{place} exists; choose another name, or use --force to replace it")
    if output.is_dir() and (suffix or not (output / "metadata.yaml").is_file()):
        raise BadUse(f"{output} is a folder and not a bag, so it is not replaced; choose another name")
    if not output.absolute().parent.is_dir():
        raise BadUse(f"{output}: there is no folder {output.parent}")
    names = known[suffix].layers if layers is None else tuple(name.strip() for name in layers.split(","))
    for name in names:
        if name not in LAYERS:
            raise BadUse(f"unknown layer {name!r} (allowed: {', '.join(LAYERS)})")
    known[suffix].check(names)
    if crs is not None and not CRS_FORM.match(crs):
        raise BadUse(f"--crs {crs}: expected EPSG:CODE, such as EPSG:32633, or the WKT of a .prj file")
    if sources and connect:
        raise BadUse("name a map.db or a log, or --connect to a service, not both")
    begun = time.monotonic()
    with _progress() as progress:
        if sources:
            opened = _from_files(list(sources), (names, level, bbox, crs))
        else:
            session = client_config(loaded := load(config_path, settings), connect, zenoh_file)
            opened = _from_service(session, loaded.config.map.name, loaded.config.keys, (names, level, bbox, crs))
        with opened as sheet:
            try:
                with whole(output) as file:
                    known[suffix].write(replace(sheet, watch=progress.tiles, stage=progress.stage), file)
            except OSError as error:
                raise Failure(f"{output}: {error.strerror or error}; it was not written") from None
    rows, columns = sheet.shape
    report: dict[str, Any] = {
        "output": str(output), "layers": list(sheet.layers), "cells": [columns, rows], "cell_size": sheet.cell_size,
        "origin": list(sheet.low), "tiles": len(sheet.tiles), "crs": sheet.crs, "seconds": time.monotonic() - begun,
    }  # fmt: skip
    if as_json:
        click.echo(json.dumps(report))
        return
    click.echo(
        f"{output}: {', '.join(sheet.layers)}; {columns} x {rows} cells of {sheet.cell_size:g} m from "
        f"({sheet.low[0]:.10g}, {sheet.low[1]:.10g}), {len(sheet.tiles)} tiles, in {report['seconds']:.1f} s"
    )


Wanted = tuple[tuple[str, ...], int, tuple[float, float, float, float] | None, str | None]
"""Layers, level, box and coordinate reference system."""


@contextmanager
def _from_files(sources: list[Path], wanted: Wanted) -> "Iterator[Sheet]":
    from roughmap_service.offline.opened_map import open_map, sheet_of

    with open_map(sources) as opened:
        try:
            with sheet_of(opened, *wanted) as sheet:
                yield sheet
        except ValueError as error:  # a layer that a map of this surface does not have
            raise BadUse(str(error)) from None


@contextmanager
def _from_service(session: "zenoh.Config", name: str, keys: dict[str, str], wanted: Wanted) -> "Iterator[Sheet]":
    from roughmap_client import NoAnswer, QueryRefused, RoughMapClient
    from roughmap_service.cli.connection import if_guarded
    from roughmap_service.exports.served import served_sheet

    try:
        with RoughMapClient(name, config=session, timeout=TIMEOUT_S, keys=keys) as client:
            sheet, served = served_sheet(client, *wanted)
            yield sheet
    except NoAnswer as error:
        hint = f"is `roughmap serve` up there, with the map {name!r}? (--connect, --set map.name=..., or name a map.db)"
        raise Failure(f"{error}; {hint}{if_guarded(session)}") from error
    except QueryRefused as error:
        raise Failure(f"the service refused: {error}") from error
    if len(served.versions) > 1:
        click.echo(
            f"roughmap: note: the map changed meanwhile; its tiles are of {len(served.versions)} states", err=True
        )


CRS_FORM = re.compile(r"EPSG:\d{4,6}$|\s*[A-Z_]+\s*\[", re.IGNORECASE)
"""A code, or the beginning of WKT."""

TIMEOUT_S = 30.0
"""How long to wait for each answer of a service."""


class _Shown:
    """A line on stderr with what is done now, the tiles written and the time left; it takes what a sheet tells."""

    def __init__(self, bar: "Progress") -> None:
        self._bar = bar
        self._task = bar.add_task("opening", total=None)

    def tiles(self, done: int, total: int) -> None:
        self._bar.update(self._task, completed=done, total=total, description="writing tiles")

    def stage(self, name: str) -> None:
        """Show a stage of unknown length."""
        self._bar.remove_task(self._task)
        self._task = self._bar.add_task(name, total=None)
        self._bar.refresh()


@contextmanager
def _progress() -> "Iterator[_Shown]":
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        yield _Shown(bar)
