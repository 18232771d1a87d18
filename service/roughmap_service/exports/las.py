"""LAS and LAZ: cells as points of class ground, with the layers as extra dimensions."""

from pathlib import Path

import laspy
import numpy as np
from lazrs import LazrsError  # type: ignore[import-untyped]

from roughmap_service.exports.layer_rules import height_first
from roughmap_service.exports.points import cell_points
from roughmap_service.exports.sheet import ExportFault, Sheet
from roughmap_service.exports.wkt import LAS, as_wkt
from roughmap_service.formats.pictures import STYLES

SCALES = (0.0001, 0.001, 0.01)
"""Metres of a step; the first with which the sheet fits in 32 bits about its middle, 214 km with the first."""

STEPS = 2**31 - 1

GROUND = 2
"""The class of points on the ground."""

RETURN_NUMBERS = 1


def write_las(sheet: Sheet, file: Path) -> None:
    """Write LAS 1.4 (LAZ by the suffix): coordinates in steps of 0.1 mm about an offset, layers as float32."""
    height_first(sheet.layers)
    reach = max(high - low for low, high in zip(sheet.low, sheet.high, strict=True)) / 2 + 1
    scale = next((scale for scale in SCALES if reach / scale < STEPS), None)
    if scale is None:
        raise ExportFault(
            f"{file.name}: a map {2 * reach / 1000:.0f} km wide does not fit in LAS; choose a part with --bbox"
        )
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = [scale] * 3
    header.offsets = [np.floor((low + high) / 2) for low, high in zip(sheet.low, sheet.high, strict=True)] + [0.0]
    header.generating_software = "roughmap"
    for name in sheet.layers[1:]:
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type="f4", description=STYLES[name][1][:32]))
    if sheet.crs is not None:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(as_wkt(sheet.crs, LAS, "a LAS file")))
        header.global_encoding.wkt = True
    try:
        _write(sheet, file, header, scale)
    except LazrsError as error:  # in place of an OSError
        raise ExportFault(f"{file}: can't be written: {error}; is the disk full?") from None


def _write(sheet: Sheet, file: Path, header: laspy.LasHeader, scale: float) -> None:
    with laspy.open(file, mode="w", header=header) as out:
        for points in cell_points(sheet):
            rows = laspy.ScaleAwarePointRecord.zeros(len(points.places), header=header)
            try:
                rows.x, rows.y, rows.z = points.places.T
            except OverflowError:
                high = float(np.abs(points.places[:, 2]).max())
                text = f"{file}: a height of {high:.0f} m does not fit in LAS beside steps of {scale} m"
                raise ExportFault(text) from None
            rows.classification[:] = GROUND
            rows.return_number[:] = RETURN_NUMBERS
            rows.number_of_returns[:] = RETURN_NUMBERS
            for number, name in enumerate(sheet.layers[1:]):
                rows[name] = points.values[:, number]
            out.write_points(rows)
