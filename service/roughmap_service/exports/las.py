"""LAS and LAZ: cells as points of class ground, with the layers as extra dimensions."""

from pathlib import Path

import laspy
import numpy as np

from roughmap_service.exports.layer_rules import height_first
from roughmap_service.exports.points import cell_points
from roughmap_service.exports.sheet import Sheet
from roughmap_service.exports.wkt import LAS, as_wkt
from roughmap_service.formats.pictures import STYLES

SCALE = 0.0001
"""Metres of a step: 214 km fit about the offset."""

GROUND = 2
"""The class of points on the ground."""

RETURN_NUMBERS = 1


def write_las(sheet: Sheet, file: Path) -> None:
    """Write LAS 1.4 (LAZ by the suffix): coordinates in steps of 0.1 mm about an offset, layers as float32."""
    height_first(sheet.layers)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = [SCALE] * 3
    header.offsets = [np.floor((low + high) / 2) for low, high in zip(sheet.low, sheet.high, strict=True)] + [0.0]
    header.generating_software = "roughmap"
    for name in sheet.layers[1:]:
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type="f4", description=STYLES[name][1][:32]))
    if sheet.crs is not None:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(as_wkt(sheet.crs, LAS, "a LAS file")))
        header.global_encoding.wkt = True
    with laspy.open(file, mode="w", header=header) as out:
        for points in cell_points(sheet):
            rows = laspy.ScaleAwarePointRecord.zeros(len(points.places), header=header)
            rows.x, rows.y, rows.z = points.places.T
            rows.classification[:] = GROUND
            rows.return_number[:] = RETURN_NUMBERS
            rows.number_of_returns[:] = RETURN_NUMBERS
            for number, name in enumerate(sheet.layers[1:]):
                rows[name] = points.values[:, number]
            out.write_points(rows)
