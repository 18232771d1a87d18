"""PNG with a world file: one layer in colours, a pixel a cell, for tools that lay pictures over maps."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from roughmap_service.exports.layer_rules import only_layer
from roughmap_service.exports.sheet import Sheet
from roughmap_service.formats.pictures import FIXED_SPAN, LOGARITHMIC, STYLES

PICTURE = "a PNG"

MAX_CELLS = 400_000_000
"""A byte each."""

SAMPLE = 8
"""Every so many cells along each side tell the range of the colours."""

UNKNOWN = 255
"""The colour that is transparent."""


def write_picture(sheet: Sheet, file: Path) -> None:
    """Write the sheet's only layer as a palette of 255 colours, transparent where unknown.

    The colours range from the 1st to the 99th percentile of the layer; the file's text has that range. The world file
    beside it (.pgw) has the size of a pixel and the centre of the upper left one.
    """
    name = only_layer(sheet.layers, PICTURE)
    sheet.check_cells(MAX_CELLS, PICTURE)
    low, high = _span(sheet, name)
    scale = 254.0 / (high - low)
    rows, columns = sheet.shape
    pixels = np.empty((rows, columns), np.uint8)
    at = 0
    for band in sheet.bands():
        values = _toned(name, band[:, :, 0])
        known = np.isfinite(values)
        shades = np.clip((np.where(known, values, low) - low) * scale, 0, 254).round().astype(np.uint8)
        pixels[at : at + len(band)] = np.where(known, shades, UNKNOWN)
        at += len(band)
    image = Image.fromarray(pixels, mode="L")
    image.putpalette(_palette(STYLES[name][2]))
    image.save(file, format="PNG", transparency=UNKNOWN, pnginfo=_text(sheet, name, low, high))
    s, (x, y) = sheet.cell_size, (sheet.low[0], sheet.high[1])
    lines = [s, 0.0, 0.0, -s, x + s / 2, y - s / 2]
    file.with_suffix(".pgw").write_text("".join(f"{value!r}\n" for value in lines), encoding="ascii")


def _toned(name: str, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Return the values as they are drawn: logarithms for layers that span orders of magnitude."""
    wide = values.astype(np.float64)
    if name not in LOGARITHMIC:
        return wide
    return np.log10(wide, out=np.full(wide.shape, np.nan), where=wide > 0)


def _span(sheet: Sheet, name: str) -> tuple[float, float]:
    if name in FIXED_SPAN:
        return FIXED_SPAN[name]
    some = [_toned(name, part.values[::SAMPLE, ::SAMPLE, 0]).ravel() for part in sheet.parts()]
    known = np.concatenate(some) if some else np.zeros(0)
    known = known[np.isfinite(known)]
    if known.size == 0:
        return 0.0, 1.0
    low, high = np.percentile(known, (1, 99)).tolist()
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _palette(colours: str) -> list[int]:
    rgb = (colormaps[colours](np.linspace(0, 1, 255))[:, :3] * 255).round().astype(int)
    return [*rgb.ravel().tolist(), 0, 0, 0]


def _text(sheet: Sheet, name: str, low: float, high: float) -> PngInfo:
    text = PngInfo()
    shown = (10.0**low, 10.0**high) if name in LOGARITHMIC else (low, high)
    text.add_text(
        "Description", f"{sheet.title}: {STYLES[name][0]}, {shown[0]:.4g} to {shown[1]:.4g} {STYLES[name][1]}"
    )
    return text
