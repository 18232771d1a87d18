"""GeoTIFF, cloud-optimised: a band a layer, with names, units and overviews."""

import tempfile
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from rasterio._err import CPLE_BaseError
from rasterio.crs import CRS
from rasterio.enums import ColorInterp
from rasterio.errors import CRSError, RasterioError
from rasterio.shutil import copy
from rasterio.windows import Window

from roughmap_service.exports.qgis_style import write_qgis_style
from roughmap_service.exports.sheet import ExportFault, Sheet
from roughmap_service.formats.pictures import STYLES

MAX_SIDE = 1 << 30
"""Cells along a side: GDAL's numbers of pixels are 32 bits."""

MAX_VALUES = 1 << 35
"""Of all layers. GDAL looks at each, empty or not, for its overviews: some 20 to 40 million a second, and heeds no
Ctrl-C meanwhile."""

BLOCK = 512
"""Cells along the side of a block, GDAL's default for cloud-optimised files."""


def write_geotiff(sheet: Sheet, file: Path) -> None:
    """Write all layers. Unknown ground is NaN, which is the file's no-data value. OSError, ExportFault."""
    try:
        _write(sheet, file)
    except (CPLE_BaseError, RasterioError) as error:
        raise OSError(f"GDAL can't write it ({error}); is the disk full?") from None


def _write(sheet: Sheet, file: Path) -> None:
    """Write a file and its style.

    A sparse file comes first, beside the result: empty blocks take no room, so a map of two distant places does not
    either.
    """
    rows, columns = sheet.shape
    sheet.check_cells(MAX_VALUES // len(sheet.layers), f"a GeoTIFF with {len(sheet.layers)} layers")
    if max(rows, columns) > MAX_SIDE:
        raise ExportFault(f"{file.name}: {columns} x {rows} cells are too many for GeoTIFF: choose a part with --bbox")
    profile = {
        "driver": "GTiff", "width": columns, "height": rows, "count": len(sheet.layers), "dtype": "float32",
        "nodata": np.nan, "tiled": True, "blockxsize": BLOCK, "blockysize": BLOCK, "compress": "zstd",
        "sparse_ok": True, "bigtiff": "if_safer", "interleave": "band",
        "transform": Affine(sheet.cell_size, 0.0, sheet.low[0], 0.0, -sheet.cell_size, sheet.high[1]),
    }  # fmt: skip
    low, high = np.inf, -np.inf
    env = rasterio.Env(
        GDAL_CACHEMAX=64 << 20, CHECK_DISK_FREE_SPACE="FALSE"
    )  # GDAL does not count empty blocks as such
    with env, tempfile.TemporaryDirectory(dir=file.parent, prefix=".export-") as room:
        sparse = Path(room) / "sparse.tif"
        with rasterio.open(sparse, "w", **profile) as written:
            if sheet.crs is not None:
                written.crs = _crs(sheet.crs)
            written.update_tags(**_tags(sheet))
            written.units = [STYLES[name][1] for name in sheet.layers]
            written.colorinterp = [ColorInterp.gray] + [ColorInterp.undefined] * (len(sheet.layers) - 1)
            for number, name in enumerate(sheet.layers, 1):
                written.set_band_description(number, name)
            for part in sheet.parts():
                if (first := part.values[:, :, 0])[np.isfinite(first)].size:
                    low, high = min(low, float(np.nanmin(first))), max(high, float(np.nanmax(first)))
                height, width = part.values.shape[:2]
                window = Window(part.i, rows - part.j - height, width, height)
                written.write(np.moveaxis(part.values[::-1], 2, 0), window=window)
        sheet.stage("adding overviews")
        copy(sparse, file, driver="COG", compress="deflate", blocksize=BLOCK, sparse_ok=True,
             resampling="average", bigtiff="if_safer")  # fmt: skip
    if low <= high:
        write_qgis_style(sheet, file, low, high)


def _crs(text: str) -> CRS:
    try:
        return CRS.from_user_input(text)
    except CRSError as error:
        raise ExportFault(f"coordinate reference system {text[:60]!r}: {error} (--crs EPSG:32633, or WKT)") from None


def _tags(sheet: Sheet) -> dict[str, str]:
    return {"TIFFTAG_SOFTWARE": "roughmap", "TIFFTAG_IMAGEDESCRIPTION": sheet.title, "map_frame": sheet.frame_id}
