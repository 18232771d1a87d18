"""Rows of the start: from the command to the ready line, warm caches; empty, and with 20,000 tiles stored."""

import shutil
import time
from pathlib import Path

import numpy as np
from figures import Bench, Mark, Row, rounds_row
from scans import CELL_SIZE
from serving import configuration, served

from roughmap_schemas.config import configuration_digest
from roughmap_schemas.config_load import load_config
from roughmap_service.run.settings import new_map
from roughmap_service.store.map_db import Store

ROUNDS = 5
TILES = 20_000


def rows(bench: Bench) -> list[Row]:
    """Seconds to the ready line, empty and stored in turn."""
    folder = bench.folder / "start"
    shutil.rmtree(folder, ignore_errors=True)
    tiles = 200 if bench.quick else TILES
    bench.say(f"start: storing {tiles:,} tiles")
    stored = _stored(folder, tiles)
    taken: dict[str, list[float]] = {"empty": [], "stored": []}
    rounds = 1 if bench.quick else ROUNDS
    for turn in range(rounds):
        bench.say(f"start: round {turn + 1} of {rounds}")
        for name, more in (("empty", ""), ("stored", stored)):
            shutil.rmtree(folder / name, ignore_errors=True)
            begun = time.perf_counter()
            with served(folder / name, more):
                seconds = time.perf_counter() - begun
            taken[name].append(seconds)
    shutil.rmtree(folder)
    more = np.subtract(taken["stored"], taken["empty"]).tolist()
    return [
        rounds_row("start", "start to ready, warm compile cache", "s", taken["empty"], mark=Mark(1.5)),
        rounds_row(
            "start.stored", f"... more with {tiles:,} tiles stored, 64 known cells each", "s", more, mark=Mark(1.0),
            reference="without", beside=taken["empty"],
        ),
    ]  # fmt: skip


def _stored(folder: Path, tiles: int) -> str:
    """A store of so many tiles, a row of cells known in each; the setting that names it."""
    setting = f'[store]\npath = "{folder / "map.db"}"\n'
    config = load_config(configuration(folder / "made", setting)).config
    across = round(tiles**0.5)
    n = np.arange(tiles)
    corner = np.stack([n % across, n // across], axis=1) * 64
    points = np.zeros((tiles, 64, 3))
    points[:, :, :2] = (corner[:, None, :] + np.stack([np.arange(64), np.full(64, 32)], axis=1) + 0.5) * CELL_SIZE
    with new_map(config) as made:
        made.add(points.reshape(-1, 3), np.eye(3) * 1e-6, 1_700_000_000 * 10**9)
        assert made.tile_count == tiles
        Store(folder / "map.db").write_map(made, config.public_dict(), configuration_digest(config), "0" * 32)
    return setting
