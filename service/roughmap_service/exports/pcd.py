"""PCD: cells as points, binary, all float32 as PCL has them, about an origin that the header names."""

from pathlib import Path

import numpy as np

from roughmap_service.exports.layer_rules import height_first
from roughmap_service.exports.points import COUNT_DIGITS, cell_points, local_origin
from roughmap_service.exports.sheet import Sheet


def write_pcd(sheet: Sheet, file: Path) -> None:
    """Write x, y, z and the other layers.

    Far from zero, as in UTM coordinates, float32 would lose half a metre. There x and y are about an origin, which is
    the VIEWPOINT of the header: what reads the file and heeds that has map coordinates again.
    """
    height_first(sheet.layers)
    fields = ["x", "y", "z", *sheet.layers[1:]]
    x, y = local_origin(sheet)
    once = " ".join("1" for _ in fields)
    before = (
        f"# .PCD v0.7 - {sheet.ascii_title}\n"
        f"# map coordinates are x + {x!r}, y + {y!r}\nVERSION 0.7\nFIELDS {' '.join(fields)}\n"
        f"SIZE {' '.join('4' for _ in fields)}\nTYPE {' '.join('F' for _ in fields)}\nCOUNT {once}\nWIDTH "
    )
    between = f"\nHEIGHT 1\nVIEWPOINT {x!r} {y!r} 0 1 0 0 0\nPOINTS "
    with file.open("wb") as out:
        out.write(_header(before, between, 0))
        count = 0
        for points in cell_points(sheet):
            rows = np.empty((len(points.places), len(fields)), "<f4")
            rows[:, :3] = points.places - (x, y, 0.0)
            rows[:, 3:] = points.values
            out.write(rows.tobytes())
            count += len(rows)
        out.seek(0)
        out.write(_header(before, between, count))


def _header(before: str, between: str, count: int) -> bytes:
    number = f"{count:0{COUNT_DIGITS}d}"
    return f"{before}{number}{between}{number}\nDATA binary\n".encode("ascii")
