"""NPZ: the layers as numpy arrays, row 0 at the lowest y, and where they lie."""

import shutil
import tempfile
import zipfile
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

from roughmap_service.exports.sheet import Sheet

MAX_CELLS = 1 << 31


def write_arrays(sheet: Sheet, file: Path) -> None:
    """Write each layer as (ny, nx) float32, NaN where unknown, and `origin`, `cell_size`, `frame_id`, `crs`.

    These are the names of `roughmap query --npz`. An archive's arrays come one after another, so all but the first wait
    in files beside it.
    """
    sheet.check_cells(MAX_CELLS, "an NPZ file")
    where = {
        "origin": np.array(sheet.low),
        "cell_size": np.array(sheet.cell_size),
        "frame_id": np.array(sheet.frame_id),
        "crs": np.array(sheet.crs or ""),
    }
    with (
        tempfile.TemporaryDirectory(dir=file.parent, prefix=".export-") as room,
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
    ):
        for name, array in where.items():
            with archive.open(f"{name}.npy", "w") as entry:
                npy.write_array(entry, array, allow_pickle=False)
        waiting = [Path(room) / name for name in sheet.layers]
        with ExitStack() as stack:
            files = [stack.enter_context(path.open("wb")) for path in waiting]
            for band in sheet.bands(upward=True):
                for number, layer in enumerate(files):
                    layer.write(band[:, :, number].tobytes())
        for number, path in enumerate(waiting, 1):
            sheet.stage(f"packing layer {number} of {len(waiting)}")
            with archive.open(f"{path.name}.npy", "w", force_zip64=True) as entry, path.open("rb") as raw:
                npy.write_array_header_1_0(entry, {"descr": "<f4", "fortran_order": False, "shape": sheet.shape})
                shutil.copyfileobj(raw, entry, 1 << 20)
