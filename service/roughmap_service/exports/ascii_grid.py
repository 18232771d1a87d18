"""ESRI ASCII grids: one layer as text, rows from the highest y."""

from pathlib import Path

import numpy as np

from roughmap_service.exports.layer_rules import only_layer
from roughmap_service.exports.sheet import ExportFault, Sheet
from roughmap_service.exports.wkt import ESRI, as_wkt

GRID = "an ASCII grid"

NODATA = -9999.0

MAX_CELLS = 400_000_000
"""About 4 GB of text."""


def write_ascii_grid(sheet: Sheet, file: Path) -> None:
    """Write the sheet's only layer with nine significant digits, which keep float32 exactly; -9999 where unknown."""
    name = only_layer(sheet.layers, GRID)
    sheet.check_cells(MAX_CELLS, GRID)
    rows, columns = sheet.shape
    with file.open("w", encoding="ascii") as text:
        text.write(
            f"ncols {columns}\nnrows {rows}\nxllcorner {sheet.low[0]!r}\nyllcorner {sheet.low[1]!r}\n"
            f"cellsize {sheet.cell_size!r}\nNODATA_value {NODATA:g}\n"
        )
        for band in sheet.bands():
            values = band[:, :, 0]
            if np.any(values == NODATA):
                raise ExportFault(f"{file.name}: {name} is {NODATA:g} somewhere, which stands for unknown in {GRID}")
            np.savetxt(text, np.where(np.isfinite(values), values, NODATA), fmt="%.9g")
    if sheet.crs is not None:
        file.with_suffix(".prj").write_text(as_wkt(sheet.crs, ESRI, "a .prj file") + "\n", encoding="utf-8")
