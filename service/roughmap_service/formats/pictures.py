"""Pictures (PNG) of map layers: axes in metres, a colour bar with units, unknown ground hatched.

No display is needed. Importing matplotlib takes a second, so only commands that draw import this module.
"""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from PIL import Image

Floats = npt.NDArray[np.float64]


class Layers(Protocol):
    """What can be drawn: a region, from the map or from a client's answer."""

    @property
    def cell_size(self) -> float:
        """Side of a cell, metres."""
        ...

    @property
    def origin(self) -> tuple[float, float]:
        """Lower-left corner, metres in the map frame."""
        ...

    def __getitem__(self, name: str, /) -> npt.NDArray[Any]:
        """Return a layer: rows along y, columns along x."""
        ...


STYLES: dict[str, tuple[str, str, str]] = {
    "mean_height": ("mean height", "m", "viridis"),
    "mid_range_height": ("mid-range height", "m", "viridis"),
    "max_height": ("highest point", "m", "viridis"),
    "min_height": ("lowest point", "m", "viridis"),
    "std_dev": ("standard deviation of height", "m", "magma"),
    "range": ("range of heights", "m", "magma"),
    "confidence_level": ("confidence level", "probability", "viridis"),
    "confidence_factor": ("confidence factor (smaller is better)", "m\u00b2 / weight", "viridis_r"),
    "mean_variance": ("variance of the mean", "m\u00b2", "magma"),
    "count": ("points that touched a cell", "points", "cividis"),
    "weight": ("weight", "1 / m\u00b3", "cividis"),
    "expected_count": ("expected points in a cell", "points", "cividis"),
    "age": ("age", "s", "cividis"),
    "gradient_x": ("gradient along x", "m / m", "RdBu_r"),
    "gradient_y": ("gradient along y", "m / m", "RdBu_r"),
    "slope": ("slope", "rad", "inferno"),
    "step_height": ("step height", "m", "inferno"),
    "traversability": ("traversability", "0 blocked, 1 free", "RdYlGn"),
    "mean_sigma": ("standard error of the mean", "m", "magma"),
    "interval_95": ("half width of the 95 % interval", "m", "magma"),
    "confidence": ("confidence", "probability", "viridis"),
    "local_confidence": ("confidence against the cells around", "probability", "viridis"),
    "roughness": ("roughness", "m", "magma"),
    "obstacle": ("obstacle", "0 none, 1 obstacle", "RdYlGn_r"),
    "obstacle_top": ("top of an obstacle over the ground", "m", "inferno"),
    "overhang_low": ("lowest overhang over the ground", "m", "cividis"),
    "passable_share": ("part of a cell that is passable", "0 blocked, 1 free", "RdYlGn"),
}
"""Layer -> its name in the picture, its unit, its colour map."""

LOGARITHMIC = frozenset({"confidence_factor", "mean_variance", "count", "weight", "expected_count"})
"""Layers that span orders of magnitude."""

HEIGHTS = frozenset({"mean_height", "mid_range_height", "max_height", "min_height"})
"""Layers drawn with hill shading: in the colours of a whole hill alone, rocks and ditches would be invisible."""

FIXED_SPAN = dict.fromkeys(
    ("confidence_level", "traversability", "confidence", "local_confidence", "obstacle", "passable_share"), (0.0, 1.0)
)


def draw(region: Layers, layers: Sequence[str], file: Path, *, title: str = "", tracks: Sequence[Floats] = ()) -> None:
    """Draw `layers` side by side into `file` (PNG), with the robots' `tracks`, each (N, 2) in metres.

    Raises OSError if the file can't be written.
    """
    rows, columns = region[layers[0]].shape
    ratio = rows / max(columns, 1)
    width = 7.2
    height = float(np.clip(width * 0.74 * ratio + 0.9, 3.5, 16.0))
    # A Figure instead of pyplot: no global state, no display, safe in any thread.
    with mpl.rc_context({"hatch.linewidth": 0.4, "font.size": 9}):
        figure = Figure(figsize=(width * len(layers), height), layout="constrained", dpi=130)
        for axes, layer in zip(np.atleast_1d(figure.subplots(1, len(layers))), layers, strict=True):
            _panel(axes, region, layer, tracks)
        if title:
            figure.suptitle(title)
        drawn = io.BytesIO()
        figure.savefig(drawn, format="png")
    # A palette halves the file. It is dithered, since 256 colours leave steps in a shaded slope.
    with Image.open(drawn) as image:
        colours = image.convert("RGB")
    palette = colours.quantize(256)
    colours.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG).save(file, format="PNG", optimize=True)


def _panel(axes: Axes, region: Layers, layer: str, tracks: Sequence[Floats]) -> None:
    name, unit, colours = STYLES.get(layer, (layer, "", "viridis"))
    values = np.asarray(region[layer], dtype=np.float64)
    known = np.isfinite(values) & ~_never_hit(layer, values)
    extent = _extent(region, values.shape)
    low, high = _span(layer, values[known])
    norm = LogNorm(low, high) if layer in LOGARITHMIC and low > 0 else Normalize(low, high)
    axes.set_facecolor("#e4e4e4")
    axes.patch.set_hatch("////")
    axes.patch.set_edgecolor("#a8a8a8")
    mappable = ScalarMappable(norm, colours)
    colour = mappable.to_rgba(np.where(known, values, low))
    if layer in HEIGHTS:
        colour[..., :3] *= _sunlight(np.where(known, values, np.nan), region.cell_size)[..., None]
    colour[..., 3] = known
    axes.imshow(colour, origin="lower", extent=extent, interpolation="nearest")
    label = f"{name} [{unit}]" if unit else name
    axes.figure.colorbar(mappable, ax=axes, label=label, shrink=0.85, extend=_extend(values[known], low, high))
    legend: list[Patch | Line2D] = [Patch(facecolor="#e4e4e4", edgecolor="#a8a8a8", hatch="////", label="unknown")]
    for number, track in enumerate(tracks):
        lines = axes.plot(track[:, 0], track[:, 1], color="#d01c8b", linewidth=1.2, label="rover's path")
        legend += lines if number == 0 else []
    axes.legend(handles=legend, loc="upper right", framealpha=0.9, fontsize=8)
    axes.set_xlim(extent[0], extent[1])
    axes.set_ylim(extent[2], extent[3])
    axes.set_aspect("equal")
    axes.ticklabel_format(style="plain", useOffset=False)  # survey coordinates in full, to be read off
    axes.tick_params(axis="x", labelrotation=45 if max(abs(extent[0]), abs(extent[1])) >= 10_000 else 0)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_title(f"{name}, cells of {region.cell_size:g} m")


def _sunlight(height: Floats, cell_size: float) -> Floats:
    """Return the brightness, 0.45 to 1, of a low sun in the north-west; 0.85 where a neighbour is unknown."""
    if min(height.shape) < 2:
        return np.ones(height.shape)
    along_y, along_x = np.gradient(height, cell_size)
    lit = (-0.5 * (along_y - along_x) + 0.8) / np.sqrt(1 + along_x**2 + along_y**2)
    return np.where(np.isfinite(lit), np.clip(0.25 + 0.75 * lit, 0.45, 1.0), 0.85)


def _never_hit(layer: str, values: Floats) -> npt.NDArray[np.bool_]:
    """Return where a cell was never hit; counts and weights are 0 there, not NaN."""
    return values == 0 if layer in {"count", "weight", "expected_count"} else np.zeros(values.shape, dtype=bool)


def _extend(known: Floats, low: float, high: float) -> str:
    """Return at which ends the colour bar gets an arrow: where values lie beyond it."""
    below, above = bool(np.any(known < low)), bool(np.any(known > high))
    return {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}[below, above]


def _extent(region: Layers, shape: tuple[int, ...]) -> tuple[float, float, float, float]:
    x, y = region.origin
    return x, x + shape[1] * region.cell_size, y, y + shape[0] * region.cell_size


def _span(layer: str, known: Floats) -> tuple[float, float]:
    """Return the range of the colours: without the outermost hundredth, so that outliers don't flatten the rest."""
    if layer in FIXED_SPAN:
        return FIXED_SPAN[layer]
    if known.size == 0:
        return 0.0, 1.0
    low, high = (float(value) for value in np.percentile(known, (1, 99)))
    return (low, high) if high > low else (low - 0.5, high + 0.5)
