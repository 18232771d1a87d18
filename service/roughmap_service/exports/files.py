"""The writer for each suffix."""

from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from roughmap_service.exports.arrays import write_arrays
from roughmap_service.exports.ascii_grid import GRID, write_ascii_grid
from roughmap_service.exports.grid_map import write_grid_map
from roughmap_service.exports.layer_rules import HEIGHT, PASSABLE, height_first, only_layer, passable_alone
from roughmap_service.exports.nav2 import write_nav2
from roughmap_service.exports.pcd import write_pcd
from roughmap_service.exports.picture import PICTURE, write_picture
from roughmap_service.exports.ply import write_ply
from roughmap_service.exports.sheet import ExportFault, Sheet

RASTER = (HEIGHT, "max_height", "interval_95", "confidence", "slope", "step_height", PASSABLE)
CLOUD = (HEIGHT, "interval_95", "confidence", "slope", PASSABLE)

Writer = Callable[[Sheet, Path], None]


class Format(NamedTuple):
    """A writer, and what can be known before a map is opened.

    Attributes:
        write: writes a sheet to a file, or makes a folder of that name.
        layers: the layers that it writes if none are named.
        check: raises ExportFault for layers that the format can't hold, and if a library is absent.
        beside: suffixes of the files that it may write beside.
    """

    write: Writer
    layers: tuple[str, ...]
    check: Callable[[tuple[str, ...]], object] = lambda _: None
    beside: tuple[str, ...] = ()


def _of_extra(module: str, function: str, library: str, extra: str) -> Writer:
    """Return the writer of a module whose library is not always installed."""
    try:
        found: Writer = getattr(import_module(f"roughmap_service.exports.{module}"), function)
    except ImportError as error:
        raise ExportFault(f"this format needs {library}: pip install 'roughmap[{extra}]' ({error})") from None
    return found


def _write_geotiff(sheet: Sheet, file: Path) -> None:
    _of_extra("geotiff", "write_geotiff", "rasterio", "geo")(sheet, file)


def _check_geotiff(_layers: tuple[str, ...]) -> None:
    _of_extra("geotiff", "write_geotiff", "rasterio", "geo")


def _write_las(sheet: Sheet, file: Path) -> None:
    _of_extra("las", "write_las", "laspy", "las")(sheet, file)


def _check_las(layers: tuple[str, ...]) -> None:
    height_first(layers)
    _of_extra("las", "write_las", "laspy", "las")


def formats(threshold: float) -> Mapping[str, Format]:
    """Return the format for each suffix; ``threshold``: from which traversability on a cell is free for Nav2."""
    geotiff = Format(_write_geotiff, RASTER, _check_geotiff, (".qml",))
    las = Format(_write_las, CLOUD, _check_las)
    return {
        ".tif": geotiff,
        ".tiff": geotiff,
        ".npz": Format(write_arrays, RASTER),
        ".asc": Format(write_ascii_grid, (HEIGHT,), lambda layers: only_layer(layers, GRID), (".prj",)),
        ".png": Format(write_picture, (HEIGHT,), lambda layers: only_layer(layers, PICTURE), (".pgw",)),
        ".yaml": Format(lambda sheet, file: write_nav2(sheet, file, threshold), (PASSABLE,), passable_alone, (".pgm",)),
        "": Format(write_grid_map, RASTER),
        ".ply": Format(write_ply, CLOUD, height_first),
        ".pcd": Format(write_pcd, CLOUD, height_first),
        ".las": las,
        ".laz": las,
    }
