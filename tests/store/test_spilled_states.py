"""Tiles with cells, trust and columns, through everything that may happen to them, against a dictionary."""

from contextlib import ExitStack, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import xxhash
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap.cell import BASED
from roughmap.tiles.eviction import Eviction
from roughmap.tiles.slots import SLOT_BYTES
from roughmap.tiles.state import TileState
from roughmap.tiles.table import TileTable
from roughmap_service.store.spill import SLICE_BYTES, Spill

Tile = tuple[int, int]
LEVELS = 3


class Tiles:
    """A table of tiles whose shelf is a spill file, and what it has to hold: the bytes of each tile."""

    def __init__(self, spill: Spill) -> None:
        self.table = TileTable((2,) * LEVELS, spill)
        self.held: list[tuple[np.ndarray, list[bytes]]] = []
        self.true: dict[Tile, bytes] = {}
        self.now = 0

    def write(self, rng: np.random.Generator) -> None:
        """Write cells of some tiles, as a scan does: room for columns, which only some need, is taken first."""
        self.now += 1
        table = self.table
        tx, ty = np.unique(rng.integers(-2, 2, (int(rng.integers(1, 5)), 2)), axis=0).astype(np.int32).T
        entries = table.levels[0].find_each(tx, ty)
        table.bring_back(entries[entries >= 0], nullcontext)
        entries, taken = table.open(entries, tx, ty, rng.uniform(size=len(tx)) < 0.5, columns=True)
        bits = np.zeros((len(tx), 64), np.uint64)
        unused = []
        for n, slot in enumerate(table.slot[entries].tolist()):
            state = table.pool.writable(slot)
            assert state.column is not None
            cells = rng.integers(0, 4096, int(rng.integers(1, 200)))
            state.cells["count"][cells] += 1
            state.cells["mean"][cells], state.trust["variance"][cells] = rng.normal(size=(2, len(cells)))
            if rng.integers(2):
                state.column["flags"][cells], state.column["bins"][cells, 7] = BASED, rng.integers(1, 256)
            bits[n, cells >> 6] = 1
            if not state.column["flags"].any():
                assert slot in taken
                unused.append(slot)
                state = state._replace(column=None)
            self.true[int(tx[n]), int(ty[n])] = raw(state)
        table.pool.drop_columns(np.array(unused, np.int32))
        table.used[entries] = self.now
        table.mark_changed(entries, tx, ty, bits, self.now)

    def leave(self, rng: np.random.Generator) -> None:
        """Move tiles out of memory; now and then some are forgotten on their way."""
        eviction = Eviction(self.table, int(rng.integers(1, 12)))
        if rng.uniform() < 0.2:
            self.forget(rng)
        eviction.write()
        if rng.uniform() < 0.2:
            self.forget(rng)
        eviction.close()

    def forget(self, rng: np.random.Generator) -> None:
        self.now += 1
        gone = [tile for tile in self.true if rng.uniform() < 0.3]
        if gone:
            tx, ty = np.array(gone, np.int32).T
            self.table.forget(self.table.levels[0].find_each(tx, ty), self.now)
        for tile in gone:
            del self.true[tile]

    def hold(self, rng: np.random.Generator) -> None:
        slots = self.table.slot[self.table.select()].copy()
        self.table.pin(slots)
        self.held.append((slots, [raw(self.table.state(slot)) for slot in slots.tolist()]))

    def let_go(self, rng: np.random.Generator) -> None:
        if self.held:
            slots, was = self.held.pop(int(rng.integers(len(self.held))))
            assert [raw(self.table.state(slot)) for slot in slots.tolist()] == was
            self.table.unpin(slots)

    def check(self) -> None:
        table = self.table
        tx, ty, digests = table.tile_digests()
        tiles = list(zip(tx.tolist(), ty.tolist(), strict=True))
        assert tiles == sorted(self.true)
        assert [row.tobytes() for row in digests] == [xxhash.xxh3_128_digest(self.true[tile]) for tile in tiles]
        for slot, tile in zip(table.slot[table.select()].tolist(), tiles, strict=True):
            assert raw(table.state(slot)) == self.true[tile]
            assert slot < 0 or bool(table.pool.column_address[slot]) == (len(self.true[tile]) > SLOT_BYTES)
        for z, level in enumerate(table.levels):
            x, y, _ = level.select()
            assert list(zip(x.tolist(), y.tolist(), strict=True)) == sorted({(x >> z, y >> z) for x, y in self.true})


def raw(state: TileState) -> bytes:
    return b"".join(array.tobytes() for array in state.arrays)


@examples(40)
@given(seed=st.integers(0, 2**32 - 1), number=st.integers(1, 60), checked=st.integers(1, 4))
def test_states_are_what_was_written(seed: int, number: int, checked: int) -> None:
    rng = np.random.default_rng(seed)
    with TemporaryDirectory() as folder, ExitStack() as stack:
        spill = stack.enter_context(Spill(Path(folder) / "tiles", 100 * SLICE_BYTES))
        tiles = Tiles(spill)
        steps = [tiles.write] * 4 + [tiles.leave] * 2 + [tiles.hold] * 2 + [tiles.let_go] * 2 + [tiles.forget]
        for step in range(number):
            steps[int(rng.integers(len(steps)))](rng)
            if step % checked == 0:
                tiles.check()
        while tiles.held:
            tiles.let_go(rng)
        tiles.check()
        table = tiles.table
        slots = table.slot[: table.size]
        assert (table.pool.used, spill.used) == (np.count_nonzero(slots >= 0), np.count_nonzero(slots < 0))
        assert not table.pool.pins.any()
        table.clear()
        assert (table.pool.nbytes, spill.used, spill.room) == (0, 0, 100), "no memory is kept for nobody"
