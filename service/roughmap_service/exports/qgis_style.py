"""QGIS's style beside a raster (.qml): it opens with the first layer in colours, not with three layers as RGB."""

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex

from roughmap_service.exports.sheet import Sheet
from roughmap_service.formats.pictures import STYLES

STEPS: Final = 16


def write_qgis_style(sheet: Sheet, file: Path, low: float, high: float) -> None:
    """Write the style of the first layer, whose colours range from ``low`` to ``high``."""
    _, unit, colours = STYLES[sheet.layers[0]]
    items = "".join(
        f'<item value="{value:.9g}" color="{to_hex(colormaps[colours](share))}" alpha="255" '
        f'label="{value:.4g} {unit}"/>\n'
        for share, value in zip(np.linspace(0, 1, STEPS), np.linspace(low, high, STEPS), strict=True)
    )
    file.with_suffix(".qml").write_text(
        '<!DOCTYPE qgis PUBLIC "http://mrcc.com/qgis.dtd" "SYSTEM">\n<qgis styleCategories="Symbology">\n<pipe>\n'
        f'<rasterrenderer type="singlebandpseudocolor" band="1" opacity="1" alphaBand="-1" nodataColor="" '
        f'classificationMin="{low:.9g}" classificationMax="{high:.9g}">\n'
        '<rastershader>\n<colorrampshader colorRampType="INTERPOLATED" classificationMode="1" clip="0" '
        f'minimumValue="{low:.9g}" maximumValue="{high:.9g}">\n{items}</colorrampshader>\n</rastershader>\n'
        "</rasterrenderer>\n</pipe>\n</qgis>\n",
        encoding="utf-8",
    )
