"""The picture of a soak run: what the service took of the machine over the time."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt

MIB = 1 << 20
LOOK = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "grid.alpha": 0.3}

PANELS: tuple[tuple[str, tuple[str, ...], float], ...] = (
    ("memory, MiB", ("rss", "beside_tiles"), MIB),
    ("tiles", ("tiles", "resident"), 1),
    ("disk, MiB", ("log", "store", "spill"), MIB),
    ("store, KiB a tile", ("store_a_tile",), 1024),
    ("descriptors, threads", ("descriptors", "threads"), 1),
    ("p99 of answers, of the way into the map, ms", ("p99", "lag"), 1e-3),
)
"""Each panel's title, the quantities in it, and the unit they are told in."""


def draw(samples: list[dict[str, float]], starts: list[float], warm: float, path: Path) -> Path:
    """Write the picture; its path. Starts of the service are dotted, the shade is the warm-up."""
    mpl.use("agg")
    minutes = np.array([sample["t"] for sample in samples]) / 60
    with mpl.rc_context(LOOK):
        figure, axes = plt.subplots(3, 2, figsize=(10, 8), layout="constrained", sharex=True)
        for axis, (title, names, unit) in zip(axes.flat, PANELS, strict=True):
            axis.axvspan(0, warm / 60, color="tab:gray", alpha=0.12)
            for start in starts[1:]:
                axis.axvline(start / 60, color="tab:gray", linestyle=":")
            for name in names:
                axis.plot(minutes, np.array([sample[name] for sample in samples]) / unit, label=name, linewidth=1)
            axis.set_title(title)
            axis.set_ylim(0, None)
            if len(names) > 1:
                axis.legend(loc="best")
        for axis in axes[-1]:
            axis.set_xlabel("minutes (grey: warm-up; dotted: restarted)")
        figure.savefig(path, dpi=110)
        plt.close(figure)
    return path
