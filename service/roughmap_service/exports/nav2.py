"""Nav2's map: a PGM picture and a YAML file, as map_server loads and saves them."""

from pathlib import Path
from typing import Final

import numpy as np

from roughmap_service.exports.layer_rules import passable_alone
from roughmap_service.exports.sheet import Sheet

FREE: Final = 254
OCCUPIED: Final = 0
UNKNOWN: Final = 205
"""Shades of map_server's own maps in trinary mode."""

FREE_THRESHOLD: Final = 0.196
OCCUPIED_THRESHOLD: Final = 0.65
"""A pixel's occupancy is (255 - shade) / 255: 0.004, 1 and 0.196. map_server takes what is between these as unknown."""

MAX_CELLS: Final = 400_000_000


def write_nav2(sheet: Sheet, file: Path, threshold: float) -> None:
    """Write FILE.yaml and FILE.pgm: cells of at least ``threshold`` traversability are free, the others occupied."""
    passable_alone(sheet.layers)
    sheet.check_cells(MAX_CELLS, "a map for Nav2")
    picture = file.with_suffix(".pgm")
    rows, columns = sheet.shape
    with picture.open("wb") as shades:
        shades.write(f"P5\n# {sheet.ascii_title}\n{columns} {rows}\n255\n".encode())
        for band in sheet.bands():
            values = band[:, :, 0]
            known = np.where(values >= np.float32(threshold), np.uint8(FREE), np.uint8(OCCUPIED))
            shades.write(np.where(np.isfinite(values), known, np.uint8(UNKNOWN)).tobytes())
    x, y = sheet.low
    file.with_suffix(".yaml").write_text(
        f"image: {picture.name}\nmode: trinary\nresolution: {sheet.cell_size!r}\norigin: [{x!r}, {y!r}, 0.0]\n"
        f"negate: 0\noccupied_thresh: {OCCUPIED_THRESHOLD}\nfree_thresh: {FREE_THRESHOLD}\n",
        encoding="ascii",
    )
