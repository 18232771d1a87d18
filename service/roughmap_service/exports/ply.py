"""PLY: cells as points, binary, coordinates in float64, layers in float32."""

from pathlib import Path

import numpy as np

from roughmap_service.exports.layer_rules import height_first
from roughmap_service.exports.points import COUNT_DIGITS, cell_points
from roughmap_service.exports.sheet import Sheet


def write_ply(sheet: Sheet, file: Path) -> None:
    """Write x, y, z (float64: survey coordinates stay exact) and the other layers as properties of their names."""
    height_first(sheet.layers)
    row = np.dtype([("place", "<f8", (3,)), ("values", "<f4", (len(sheet.layers) - 1,))])
    properties = [f"property double {axis}" for axis in "xyz"] + [f"property float {name}" for name in sheet.layers[1:]]
    before = f"ply\nformat binary_little_endian 1.0\ncomment {sheet.ascii_title}\nelement vertex "
    with file.open("wb") as out:
        out.write(f"{before}{0:0{COUNT_DIGITS}d}\n".encode() + "\n".join([*properties, "end_header\n"]).encode())
        count = 0
        for points in cell_points(sheet):
            rows = np.empty(len(points.places), row)
            rows["place"], rows["values"] = points
            out.write(rows.tobytes())
            count += len(rows)
        out.seek(len(before))
        out.write(f"{count:0{COUNT_DIGITS}d}".encode())
