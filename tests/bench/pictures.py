"""The benchmark's pictures: cost a point over tiles held and over coherence, latencies under load."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from figures import Row
from matplotlib import pyplot as plt
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

LOOK = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "grid.alpha": 0.3}


def draw(rows: list[Row], folder: Path) -> list[Path]:
    """Write those pictures of which there are rows; their paths."""
    mpl.use("agg")
    found = {row.key: row for row in rows}
    with mpl.rc_context(LOOK):
        drawn = [_held(found, folder), _coherence(found, folder), _latency(found, folder)]
    return [path for path in drawn if path is not None]


def _save(figure: plt.Figure, path: Path) -> Path:
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return path


def _held(rows: dict[str, Row], folder: Path) -> Path | None:
    """ns a point over tiles held, the drive and the jumping scans."""
    kinds = {
        "the drive": [row for key, row in rows.items() if key.startswith("held.") and key.count(".") == 1],
        "every scan at another place": [row for key, row in rows.items() if key.endswith(".jumping")],
    }
    if not kinds["the drive"]:
        return None
    figure, axes = plt.subplots(layout="constrained", figsize=(6, 3.6))
    for name, line in kinds.items():
        tiles = [int(row.key.split(".")[1]) for row in line]
        value = np.array([row.value for row in line])
        error = [value - [row.low for row in line], [row.high for row in line] - value]
        axes.errorbar(tiles, value, error, marker="o", capsize=3, label=name)
    first = kinds["the drive"][0].value
    axes.axhspan(0, 1.1 * first, color="tab:green", alpha=0.08, label="within 10 % of ten tiles")
    axes.set(xscale="log", ylim=(0, None), xlabel="tiles held", ylabel="ns a point, one core", title="add_scan, cuboid")
    axes.legend(loc="lower right")
    return _save(figure, folder / "tiles-held.png")


def _coherence(rows: dict[str, Row], folder: Path) -> Path | None:
    """ns a point over the order of a scan's points and the width of footprints."""
    bars = {
        "core.cuboid": "rings,\none pose",
        "core.deskew": "rings,\nown times",
        "core.order.columns": "columns,\nown times",
        "core.order.mixed": "no order,\none pose",
        "core.order.scattered": "no order,\nown times",
        "core.wide": "30 to 60 m\naway",
    }
    if not all(key in rows for key in bars):
        return None
    figure, axes = plt.subplots(layout="constrained", figsize=(7, 3.6))
    shown = [rows[key] for key in bars]
    value = np.array([row.value for row in shown])
    error = [value - [row.low for row in shown], [row.high for row in shown] - value]
    axes.bar(list(bars.values()), value, yerr=error, capsize=3, color="tab:blue")
    for place, row in enumerate(shown):
        axes.annotate(f"{row.value:.0f}", (place, row.high), ha="center", va="bottom")
    axes.grid(visible=False, axis="x")
    axes.set(ylabel="ns a point, one core", title="add_scan, cuboid, by the order of points")
    return _save(figure, folder / "coherence.png")


def _latency(rows: dict[str, Row], folder: Path) -> Path | None:
    """How many of the answers, and of the scans, took longer: the tail is what a planner meets."""
    kinds = {
        "latency.65k.p99": "a scan of 65k points, queryable",
        "latency.131k.p99": "a scan of 131k points, queryable",
        "tile.loaded.p99": "a tile, 2 layers",
        "planner.p99": "a planner's 20 x 20 m, 2 layers",
    }
    shown = {label: np.sort(rows[key].samples) for key, label in kinds.items() if key in rows and rows[key].samples}
    if not shown:
        return None
    figure, axes = plt.subplots(layout="constrained", figsize=(7, 4.4))
    for label, ms in shown.items():
        axes.step(ms, 1.0 - np.arange(len(ms)) / len(ms), where="pre", label=f"{label} (n = {len(ms)})")
    axes.axhline(0.01, color="grey", linestyle=":", linewidth=1)
    axes.set(
        xscale="log", yscale="log", xlabel="ms", ylabel="part that took longer", title="while scans come in at 10 Hz"
    )
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return _save(figure, folder / "latency.png")
