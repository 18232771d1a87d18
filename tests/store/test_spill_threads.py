"""One writer, its tiles leaving memory, readers and snapshots at once: every reading is of one moment, whole."""

import itertools
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from service_tools import WAIT_S

from roughmap import RoughMap
from roughmap.tiles.digest import digest_sum, map_digest
from roughmap.tiles.slots import SLOT_BYTES
from roughmap_service.run.view import View
from roughmap_service.store.map_db import Cut, Store
from roughmap_service.store.memory_limit import MemoryLimit
from roughmap_service.store.spill import SLICE_BYTES, Spill

SCANS = 150
READERS = 3
RESIDENT = 20
"""Tiles that may be in memory; the ground has 64."""


def ground(seed: int) -> np.ndarray:
    """(N, 3) over 3 x 3 tiles somewhere among 8 x 8."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0.0, 19.0, (2, 200)) + rng.uniform(0.0, 32.0, (2, 1))
    return np.column_stack([x, y, 0.1 * x + rng.normal(0, 0.02, 200)])


class Watched(View):
    """Knows which thread holds its lock."""

    holder = 0

    @contextmanager
    def _held(self) -> Iterator[None]:
        with super()._held():
            self.holder = threading.get_ident()
            try:
                yield
            finally:
                self.holder = 0


class Moments:
    """The digest of the map at every (epoch, sequence), as its writer saw it; and what was seen by others."""

    def __init__(self) -> None:
        self.true: dict[tuple[int, int], str] = {}
        self.seen: list[tuple[tuple[int, int], str]] = []
        self.done = threading.Event()
        self.looked = threading.Semaphore(0)


def write(view: View, memory: MemoryLimit, moments: Moments) -> None:
    """Scans, now and then a reset; what can leave leaves in between. It waits for readers now and then."""
    for seed in range(SCANS):
        memory.relieve(view.reading)
        if seed % 40 == 39:
            with view.change() as rough_map:
                rough_map.reset()
                view.epoch += 1
                moments.true[view.epoch, rough_map.sequence] = rough_map.digest()
        prepared = view.map.prepare_points(ground(seed), np.eye(3) * 0.02**2, seed * 10**9, reader_lock=view.reading)
        with view.change() as rough_map:
            rough_map.integrate(prepared)
            moments.true[view.epoch, rough_map.sequence] = rough_map.digest()
        if seed % 10 == 0:
            assert moments.looked.acquire(timeout=WAIT_S)


def read(view: View, moments: Moments) -> None:
    """Digests of all tiles, from their bytes, one reading after the other."""
    while not moments.done.is_set():
        with view.freeze() as (frozen, epoch):
            tiles = frozen.tiles
            rows = [np.frombuffer(bytes.fromhex(frozen.digest(x, y)), np.uint8) for x, y in tiles.tolist()]
            frozen.tile_layers(0, 0, ["slope", "traversability"])
        if rows:
            total = digest_sum(tiles[:, 0], tiles[:, 1], np.array(rows))
            moments.seen.append(((epoch, frozen.sequence), map_digest(len(tiles), total)))
        moments.looked.release()


def store_cuts(view: View, moments: Moments, store: Store, cut: Callable[[int, int], Cut]) -> None:
    """Whole cuts to a store, read back from there."""
    while not moments.done.is_set():
        with view.freeze() as (frozen, epoch):
            store.write(cut(epoch, frozen.sequence), frozen, None)
        back = RoughMap(threads=1)
        made = store.read_cut()
        assert made is not None
        store.load_into(back, made)
        moments.seen.append(((made.epoch, made.sequence), back.digest()))
        moments.looked.release()


def test_readers_and_snapshots_see_whole_moments_while_tiles_come_and_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And reading or writing the spill file blocks no other thread."""
    moments, store = Moments(), Store(tmp_path / "map.db")

    def cut(epoch: int, sequence: int) -> Cut:
        return Cut("f" * 32, epoch, sequence, 0, 0, 1, {}, "")

    with Spill(tmp_path / "tiles", 1000 * SLICE_BYTES) as spill:
        rough_map = RoughMap(threads=1, shelf=spill)
        rough_map.limit_cache(4 * SLOT_BYTES)
        view = Watched(rough_map, 1)
        at_the_file = []

        def watched(act: Callable[..., Any]) -> Callable[..., Any]:
            def watch(*args: Any) -> Any:
                at_the_file.append(view.holder == threading.get_ident())
                return act(*args)

            return watch

        monkeypatch.setattr(spill, "read", watched(spill.read))
        monkeypatch.setattr(spill, "write", watched(spill.write))
        before = itertools.chain([0], itertools.repeat(1))  # what the map holds now counts, too
        memory = MemoryLimit(
            RESIDENT * SLOT_BYTES, spill, measure=lambda: next(before) * view.map.resident_tiles * SLOT_BYTES
        )
        with view.change():
            rough_map.add(ground(999), np.eye(3) * 0.02**2, 0)
        moments.true[1, 1] = rough_map.digest()
        with ThreadPoolExecutor(READERS + 1) as pool:
            others = [pool.submit(read, view, moments) for _ in range(READERS)]
            others.append(pool.submit(store_cuts, view, moments, store, cut))
            try:
                write(view, memory, moments)
            finally:
                moments.done.set()
            for other in others:
                other.result(WAIT_S)
        memory.relieve(view.reading)  # now that nobody holds any
        assert rough_map.resident_tiles < rough_map.tile_count
        with view.change():
            rough_map.reset()
        assert spill.used == 0, "all that readers held is given back"
    assert len(at_the_file) > SCANS
    assert not any(at_the_file), "under the view's lock"
    assert len({moment for moment, _ in moments.seen}) > 10
    for moment, digest in moments.seen:
        assert digest == moments.true[moment]
