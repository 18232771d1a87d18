"""Pictures of what a planner reads: before, by the paper's method, and after, of the ground."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.colors import ListedColormap
from PIL import Image
from right_maps import Seen

TITLES = {"all": 'surface = "all": every return', "ground": 'surface = "ground"'}


def draw(by_surface: dict[str, Seen], title: str, path: Path, way: np.ndarray | None = None) -> Path:
    """Traversability by both surfaces side by side, and ``way`` (M, 2) if a robot drove there."""
    mpl.use("agg")
    figure, both = plt.subplots(1, 2, figsize=(11, 5.4), layout="constrained", sharex=True, sharey=True)
    for axes, (surface, name) in zip(both, TITLES.items(), strict=True):
        seen = by_surface[surface]
        half = seen.grid.cell / 2
        x, y = seen.grid.x, seen.grid.y
        extent = (x[0, 0] - half, x[0, -1] + half, y[0, 0] - half, y[-1, 0] + half)
        free = np.where(seen.free, seen.traversability, np.nan)
        drawn = axes.imshow(free, origin="lower", extent=extent, vmin=0, vmax=1, cmap="YlGn", interpolation="nearest")
        no = np.where(seen.forbidden, 1.0, np.nan)
        axes.imshow(no, origin="lower", extent=extent, cmap=ListedColormap(["tab:red"]), interpolation="nearest")
        axes.set(title=name, xlabel="x, m", facecolor="0.88")
        if way is not None:
            axes.plot(way[:, 0], way[:, 1], color="tab:blue", linewidth=1.5)
    both[0].set_ylabel("y, m")
    figure.colorbar(drawn, ax=both, label="traversability; red: forbidden; grey: not known", shrink=0.85)
    figure.suptitle(title)
    figure.set_dpi(110)
    figure.canvas.draw()
    pixels = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")
    pixels.quantize(256).save(path, optimize=True)  # a third of the size
    plt.close(figure)
    return path
