"""`roughmap query`: get a region of a running service's map as a table, a picture or arrays."""

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from roughmap_service.cli.figures import metres, statistic
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
from roughmap_service.host.log_lines import printable

if TYPE_CHECKING:
    from roughmap_client import Region

PASSING = frozenset({"busy", "shutting_down", "internal"})
"""Error codes that say something of the service's state; all others say that the query is wrong."""

Stats = dict[str, float | int | None]


@click.command
@click.option(
    "--bbox", required=True, type=bounding_box, metavar="XMIN,YMIN,XMAX,YMAX", help="Region in the map frame, metres."
)
@click.option(
    "--layers", default="mean_height,range,confidence_factor", show_default=True, help="Layers, separated by commas."
)
@click.option(
    "--level",
    type=click.IntRange(0, 24),
    default=0,
    show_default=True,
    help="Level; 0 is the finest, and each level doubles the cell size.",
)
@click.option(
    "--tolerance",
    type=click.FloatRange(0, min_open=True),
    help="Height tolerance for confidence_level, metres. [default: the map's]",
)
@click.option("--map", "map_name", help="Name of the map. [default: map.name of the configuration]")
@connect_option
@zenoh_option
@click.option(
    "--timeout",
    type=click.FloatRange(0.1, 3600),
    default=10.0,
    show_default=True,
    help="How long to wait for an answer, in seconds.",
)
@click.option(
    "--png", type=click.Path(path_type=Path, dir_okay=False), help="Draw the layers side by side into this file."
)
@click.option(
    "--npz", type=click.Path(path_type=Path, dir_okay=False), help="Save the layers as arrays into this file."
)
@config_options
@json_option
def query(
    bbox: tuple[float, float, float, float],
    layers: str,
    level: int,
    tolerance: float | None,
    map_name: str | None,
    connect: tuple[str, ...],
    zenoh_file: Path | None,
    timeout: float,
    png: Path | None,
    npz: Path | None,
    config_path: Path | None,
    settings: tuple[tuple[str, object], ...],
    as_json: bool,
) -> None:
    """roughmap query --bbox -5,-5,5,5 --layers mean_height,slope --png ground.png

    Get a rectangle of the map from a running service. For each layer, print the number of known cells and the minimum,
    median, mean and maximum of their values. --npz saves the arrays (row 0 at the lowest y, NaN where
    unknown) with origin, cell_size, sequence and epoch.
    """
    from roughmap_client import NoAnswer, QueryRefused, RoughMapClient
    from roughmap_client.errors import BadArgument
    from roughmap_schemas.layers import LAYERS
    from roughmap_service.cli.connection import client_config, if_guarded

    names = [name.strip() for name in layers.split(",")]
    for name in names:
        if name not in LAYERS:
            raise BadUse(f"unknown layer {name!r} (allowed: {', '.join(LAYERS)})")
    loaded = load(config_path, settings)
    config = loaded.config
    name = map_name or config.map.name
    session = client_config(loaded, connect, zenoh_file)
    begun = time.perf_counter()
    try:
        with RoughMapClient(name, config=session, timeout=timeout, keys=config.keys) as client:
            asked = time.perf_counter()
            region = client.region(bbox, names, level=level, tolerance=tolerance)
            answered = time.perf_counter()
    except NoAnswer as error:
        hint = f"is `roughmap serve` up there, with the map {name!r}? (--connect, --map)"
        raise Failure(f"{error}; {hint}{if_guarded(session)}") from error
    except BadArgument as error:
        raise BadUse(str(error)) from error
    except QueryRefused as error:
        raise (Failure if error.code in PASSING else BadUse)(f"the service refused: {error}") from error
    if npz is not None:
        _save(npz, region, names)
    if png is not None:
        from roughmap_service.formats.pictures import draw

        draw(region, names, png, title=f"{name}, sequence {region.sequence}")
    report = {
        "map": name,
        "epoch": region.epoch,
        "sequence": region.sequence,
        "level": level,
        "cell_size": region.cell_size,
        "origin": list(region.origin),
        "shape": list(region[names[0]].shape),
        "connect_s": asked - begun,
        "answer_s": answered - asked,
        "layers": {layer: statistics(layer, region[layer]) for layer in names},
    }
    if as_json:
        click.echo(json.dumps(report))
    else:
        _table(report)


def _save(file: Path, region: "Region", names: list[str]) -> None:
    import numpy as np

    arrays: dict[str, Any] = {
        "origin": np.array(region.origin),
        "cell_size": region.cell_size,
        "sequence": region.sequence,
        "epoch": region.epoch,
        **{name: region[name] for name in names},
    }
    with file.open("wb") as stream:
        np.savez_compressed(stream, **arrays)


def statistics(layer: str, values: Any) -> Stats:
    """Return the number of known cells and the minimum, median, mean and maximum of their values.

    Counts and weights are 0, not NaN, in unknown cells.
    """
    import numpy as np

    array = np.asarray(values, dtype=np.float64)
    known = np.isfinite(array) & ((array != 0) | (layer not in {"count", "weight", "expected_count"}))
    found = array[known]
    if found.size == 0:
        return {"known": 0, "min": None, "median": None, "mean": None, "max": None}
    return {
        "known": int(found.size),
        "min": float(found.min()),
        "median": float(np.median(found)),
        "mean": float(found.mean()),
        "max": float(found.max()),
    }


def _table(report: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    rows, columns = report["shape"]
    x, y = report["origin"]
    click.echo(
        f"{printable(report['map'])}: {columns} x {rows} cells of {metres(report['cell_size'])} m "
        f"from ({metres(x)}, {metres(y)}), "
        f"sequence {report['sequence']}, answered in {report['answer_s'] * 1e3:.1f} ms"
    )
    table = Table(box=None, pad_edge=False)
    table.add_column("layer")
    for heading in ("known", "min", "median", "mean", "max"):
        table.add_column(heading, justify="right")
    for layer, stats in report["layers"].items():
        cells = ["-" if (value := stats[key]) is None else statistic(value) for key in ("min", "median", "mean", "max")]
        table.add_row(layer, f"{stats['known']:,}", *cells)
    Console(highlight=False).print(table)
