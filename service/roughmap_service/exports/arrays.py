"""NPZ: the layers as numpy arrays, row 0 at the lowest y, and where they lie."""

import zipfile
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

from roughmap_service.exports.sheet import Sheet

MAX_CELLS = 1 << 31


def write_arrays(sheet: Sheet, file: Path) -> None:
    """Write each layer as (ny, nx) float32, NaN where unknown, and `origin`, `cell_size`, `frame_id`, `crs`.

    These are the names of `roughmap query --npz`. Each layer is a pass over the map, since an archive's arrays come one
    after another.
    """
    sheet.check_cells(MAX_CELLS, "an NPZ file")
    where = {
        "origin": np.array(sheet.low), "cell_size": np.array(sheet.cell_size), "frame_id": np.array(sheet.frame_id),
        "crs": np.array(sheet.crs or ""),
    }  # fmt: skip
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in where.items():
            with archive.open(f"{name}.npy", "w") as entry:
                npy.write_array(entry, array, allow_pickle=False)
        for name in sheet.layers:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                npy.write_array_header_1_0(entry, {"descr": "<f4", "fortran_order": False, "shape": sheet.shape})
                for band in sheet.only(name).bands(upward=True):
                    entry.write(band.tobytes())
