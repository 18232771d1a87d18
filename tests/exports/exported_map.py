"""A stored map with holes, in survey coordinates, and the layers that an export of it must have."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from roughmap import RoughMap
from roughmap_schemas import Config, configuration_digest
from roughmap_service.run.settings import new_map
from roughmap_service.store.map_db import Store

EAST, NORTH, SIDE = 412_345.0, 5_654_321.0, 0.25
LAYERS = ("mean_height", "max_height", "interval_95", "confidence", "slope", "step_height", "traversability")


@dataclass(frozen=True)
class Stored:
    """A map.db, and layers (ny, nx) over all of its tiles, as the core gives them."""

    path: Path
    low: tuple[float, float]
    layers: dict[str, np.ndarray]


def ground(rng: np.random.Generator, east: float, north: float, width: float, height: float) -> np.ndarray:
    """Points on a slope with a hole and a step."""
    x, y = rng.uniform(0, width, 30_000), rng.uniform(0, height, 30_000)
    z = 0.1 * x + 0.05 * np.sin(3 * y) + np.where(y > 0.6 * height, 0.4, 0.0) + rng.normal(0, 0.004, x.size)
    keep = np.hypot(x - width / 2, y - height / 3) > 1.5
    return np.column_stack([east + x, north + y, 120.0 + z])[keep]


def store(folder: Path, crs: str | None = None) -> Stored:
    """Store a map of 20 x 18 m, on several tiles."""
    config = Config.model_validate({"map": {"name": "site", "cell_size": SIDE}})
    rng = np.random.default_rng(5)
    with new_map(config) as built:
        built.add(ground(rng, EAST, NORTH, 20.0, 18.0), np.eye(3) * 1e-4, 1_700_000_000_000_000_000)
        path = folder / "map.db"
        Store(path).write_map(built, config.public_dict(), configuration_digest(config), "ab12", crs)
        return Stored(path, *layers_over(built))


def layers_over(built: RoughMap) -> tuple[tuple[float, float], dict[str, np.ndarray]]:
    """The lower-left corner of the map's tiles, and the layers over all of them, float32."""
    extent = built.extent()
    assert extent is not None
    region = built.region(extent, LAYERS)
    assert region.origin == extent[:2]
    return region.origin, {name: region[name].astype(np.float32) for name in LAYERS}
