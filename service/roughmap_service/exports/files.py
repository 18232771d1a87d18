"""The writer for each suffix."""

from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from roughmap_service.exports.arrays import write_arrays
from roughmap_service.exports.ascii_grid import write_ascii_grid
from roughmap_service.exports.grid_map import write_grid_map
from roughmap_service.exports.nav2 import write_nav2
from roughmap_service.exports.pcd import write_pcd
from roughmap_service.exports.picture import write_picture
from roughmap_service.exports.ply import write_ply
from roughmap_service.exports.sheet import ExportFault, Sheet

RASTER = ("mean_height", "max_height", "interval_95", "confidence", "slope", "step_height", "traversability")
CLOUD = ("mean_height", "interval_95", "confidence", "slope", "traversability")


class Format(NamedTuple):
    """A writer, and the layers that it writes if none are named."""

    write: Callable[[Sheet, Path], None]
    layers: tuple[str, ...]


def _of_extra(module: str, function: str, library: str, extra: str) -> Callable[[Sheet, Path], None]:
    """Return a writer whose module is imported when it writes, since its library is not always installed."""

    def write(sheet: Sheet, file: Path) -> None:
        try:
            found = import_module(f"roughmap_service.exports.{module}")
        except ImportError as error:
            raise ExportFault(f"{file}: needs {library}: pip install 'roughmap[{extra}]' ({error})") from None
        getattr(found, function)(sheet, file)

    return write


def formats(threshold: float) -> Mapping[str, Format]:
    """Return the format for each suffix; ``threshold``: from which traversability on a cell is free for Nav2."""
    geotiff = Format(_of_extra("geotiff", "write_geotiff", "rasterio", "geo"), RASTER)
    las = Format(_of_extra("las", "write_las", "laspy", "las"), CLOUD)
    return {
        ".tif": geotiff,
        ".tiff": geotiff,
        ".npz": Format(write_arrays, RASTER),
        ".asc": Format(write_ascii_grid, ("mean_height",)),
        ".png": Format(write_picture, ("mean_height",)),
        ".yaml": Format(lambda sheet, file: write_nav2(sheet, file, threshold), ("traversability",)),
        "": Format(write_grid_map, RASTER),
        ".ply": Format(write_ply, CLOUD),
        ".pcd": Format(write_pcd, CLOUD),
        ".las": las,
        ".laz": las,
    }
