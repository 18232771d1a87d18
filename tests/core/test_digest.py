"""The digest, computed independently from the state as the contract defines it."""

import struct
import sys
import tracemalloc

import numpy as np
import pytest
import xxhash
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from strategies import MODELS, clouds

from roughmap import CELL_DTYPE, RoughMap
from roughmap.cell import COLUMN_DTYPE, TRUST_DTYPE
from roughmap.tiles import table as tiles
from roughmap.tiles.shelf import Shelf
from roughmap.tiles.state import TileState

CELL = ("count", "updated", "weight", "weight_sq", "mean", "m2", "min", "max", "inv_cf")
TRUST = ("variance", "shared", "pose_variance", "mount_sigma", "stamp_ms")


def by_the_contract(m: RoughMap) -> str:
    """Compute the digest from the known cells, packed field by field; all other cells are zero bytes."""
    number = total = 0
    with m.freeze() as frozen:
        for tx, ty in frozen.tiles.tolist():
            state = frozen.state(tx, ty)
            assert state is not None
            cells, trust, column = bytearray(64 * 4096), bytearray(20 * 4096), bytearray(64 * 4096)
            for n in np.flatnonzero(state.cells["count"]).tolist():
                cell, known = state.cells[n], state.trust[n]
                struct.pack_into("<II7d", cells, 64 * n, *(cell[name].item() for name in CELL))
                struct.pack_into("<4fI", trust, 20 * n, *(known[name].item() for name in TRUST))
                if state.column is not None:
                    above = state.column[n]
                    numbers = (above[name].item() for name in COLUMN_DTYPE.names[:-1])
                    struct.pack_into("<HHIdIi40s", column, 64 * n, *numbers, above["bins"].tobytes())
            hashed = xxhash.xxh3_128(bytes(cells + trust))
            if state.column is not None:
                hashed.update(bytes(column))
            total += xxhash.xxh3_128_intdigest(struct.pack("<ii", tx, ty) + hashed.intdigest().to_bytes(16, "big"))
            number += 1
    return xxhash.xxh3_128_hexdigest(number.to_bytes(8, "little") + (total % 2**128).to_bytes(16, "little"))


@pytest.mark.parametrize(
    ("dtype", "size", "names", "formats", "offsets"),
    [
        (CELL_DTYPE, 64, CELL, ["<u4", "<u4"] + ["<f8"] * 7, [0, 4, 8, 16, 24, 32, 40, 48, 56]),
        (TRUST_DTYPE, 20, TRUST, ["<f4"] * 4 + ["<u4"], [0, 4, 8, 12, 16]),
        (
            COLUMN_DTYPE,
            64,
            ("candidates", "flags", "unused", "candidate_mean", "above_updated", "base", "bins"),
            ["<u2", "<u2", "<u4", "<f8", "<u4", "<i4", "|V40"],
            [0, 2, 4, 8, 16, 20, 24],
        ),
    ],
    ids=["cells", "trust", "column"],
)
def test_the_records(
    dtype: np.dtype, size: int, names: tuple[str, ...], formats: list[str], offsets: list[int]
) -> None:
    assert dtype.itemsize == size
    assert dtype.names == names
    assert [dtype[name].str for name in names] == formats
    assert [dtype.fields[name][1] for name in names] == offsets


@examples(60)
@given(cloud=clouds(), model=st.sampled_from(MODELS), cuts=st.integers(1, 3))
def test_any_map(cloud: tuple[np.ndarray, np.ndarray, np.ndarray], model: str, cuts: int) -> None:
    """The digest is checked after each call, so that an outdated one would show."""
    points, S, stamps = cloud
    m = RoughMap(error_model=model, threads=1)
    for part in np.array_split(np.arange(len(points)), cuts):
        m.add(points[part], S[part], stamps[part])
        assert m.digest() == by_the_contract(m)


STEPS = st.lists(
    st.tuples(st.sampled_from(["add", "add", "add", "forget", "load", "reset"]), st.integers(0, 2**32 - 1)),
    min_size=1,
    max_size=12,
)


@examples(60)
@given(steps=STEPS, asked=st.integers(1, 4))
def test_any_order_of_changes(steps: list[tuple[str, int]], asked: int) -> None:
    """The digest is asked for now and then, so that changes lie between; a tile may change, go and come anew."""
    m = RoughMap(cell_size=1.0, error_model="point", threads=1)
    for number, (what, seed) in enumerate(steps):
        rng = np.random.default_rng(seed)
        near = rng.integers(-2, 2, (int(rng.integers(1, 6)), 2))
        if what == "add":
            m.add(np.column_stack([near * 64.0 + 0.5, rng.normal(size=len(near))]))
        elif what == "forget":
            m.forget(near)
        elif what == "reset":
            m.reset()
        elif not any((m.tile_sequences()[0] == near[0]).all(axis=1)):
            m.load_tile(*near[0].tolist(), some_tile(rng), 0, 0, None)
        if number % asked == 0:
            assert m.digest() == by_the_contract(m)
    assert m.digest() == by_the_contract(m)


def some_tile(rng: np.random.Generator) -> TileState:
    """A tile with some known cells, half of the time with a column."""
    cells, trust, column = (np.zeros(4096, dtype) for dtype in (CELL_DTYPE, TRUST_DTYPE, COLUMN_DTYPE))
    known = rng.choice(4096, 9, replace=False)
    cells["count"][known], cells["mean"][known] = 1, rng.normal(size=9)
    trust["variance"][known] = rng.uniform(size=9)
    column["flags"][known[:5]], column["base"][known[:5]], column["bins"][known[:5]] = 2, -11, rng.integers(255)
    return TileState(cells, trust, column if rng.integers(2) else None)


def test_tiles_of_all_numbers_in_order() -> None:
    """Listed as signed numbers: as unsigned ones -1 would come last, and as little-endian bytes 256 before 1."""
    m = RoughMap(cell_size=1.0, error_model="point", threads=1)
    places = [(1, -1), (-1, 0), (0, 256), (0, 1), (0, -2), (256, 0), (-(2**25), 5), (2**25 - 1, -7)]
    m.add([(64.0 * x, 64.0 * y, 1.0) for x, y in places])
    tx, ty, digests = m.tile_digests()
    assert list(zip(tx.tolist(), ty.tolist(), strict=True)) == sorted(places)
    assert digests.shape == (8, 16)
    assert m.digest() == by_the_contract(m)


def test_an_empty_map_and_a_reset_one() -> None:
    m = RoughMap(error_model="point", threads=1)
    empty = xxhash.xxh3_128_hexdigest(bytes(24))
    assert m.digest() == empty
    m.add([(0.0, 0.0, 1.0)])
    assert m.digest() != empty
    m.reset()
    assert m.digest() == empty
    assert m.sequence == 2


@pytest.mark.parametrize("other", [{"height": 1.0 + 2**-52}, {"x": 0.15}, {"y": -0.05}, {"stamp_s": 4}, {"times": 2}])
def test_any_difference_shows(other: dict[str, float]) -> None:
    def digest(height: float = 1.0, x: float = 0.05, y: float = 0.05, stamp_s: int = 3, times: int = 1) -> str:
        m = RoughMap(error_model="point", threads=1)
        m.add([(x, y, height)] * times, stamp_ns=stamp_s * 10**9)
        return m.digest()

    assert digest(**other) != digest()


@pytest.mark.parametrize("part", ["cells", "trust", "column"])
def test_a_difference_in_any_array_shows(part: str) -> None:
    found = []
    for byte in (0, 1):
        m, state = RoughMap(threads=1), some_tile(np.random.default_rng(0))
        assert state.column is not None
        known = np.flatnonzero(state.column["flags"])[0]
        getattr(state, part).view(np.uint8).reshape(4096, -1)[known, 18] += byte
        m.load_tile(0, 0, state, 0, 0)
        found.append(m.digest())
    assert found[0] != found[1]


def test_stamps_within_a_millisecond_and_sequences_do_not_count() -> None:
    """The oldest stamp, newest stamp and sequence of a tile are not part of its digest."""
    first, second = (RoughMap(error_model="point", threads=1) for _ in range(2))
    first.add([(0.0, 0.0, 1.0)], stamp_ns=3 * 10**9)
    second.reset()
    second.add([(0.0, 0.0, 1.0)], stamp_ns=3 * 10**9 + 999)
    assert first.digest() == second.digest()


def test_tiles_loaded_from_a_store_count_like_those_that_were_built() -> None:
    m, copy = (RoughMap(error_model="point", threads=1) for _ in range(2))
    m.add([(0.05, 0.05, 1.0), (-9.0, 3.0, 2.0)])
    tx, ty, digests = m.tile_digests()
    with m.freeze() as frozen:
        for x, y, digest in zip(tx.tolist(), ty.tolist(), digests, strict=True):
            state = frozen.state(x, y)
            assert state is not None
            copy.load_tile(x, y, state, 0, 0, digest.tobytes())
    assert copy.digest() == m.digest()
    # A change discards the stored digest.
    m.add([(0.05, 0.05, 1.0)])
    copy.add([(0.05, 0.05, 1.0)])
    assert copy.digest() == m.digest() == by_the_contract(copy)


def test_only_what_has_changed_is_digested(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    monkeypatch.setattr(tiles, "tile_digest", lambda state, true=tiles.tile_digest: made.append(state) or true(state))
    m = RoughMap(cell_size=1.0, error_model="point", threads=1)
    for change, number in (
        (lambda: m.add([(64.0 * x, 0.0, 1.0) for x in range(20)]), 20),
        (lambda: m.add([(64.0, 0.0, 1.0), (128.0, 0.0, 1.0)]), 2),
        (lambda: m.forget([(1, 0), (19, 0)]), 0),
        (lambda: m.add([(0.0, 0.0, 1.0), (64.0, 0.0, 1.0)]), 2),
        (lambda: None, 0),
        (m.reset, 0),
    ):
        change()
        made.clear()
        assert m.digest() == m.digest() == by_the_contract(m)
        assert len(made) == number


class Shelved(Shelf):
    """A shelf with room for any number of tiles, none of which is read."""

    def _grow(self) -> None:
        self._extend(1 << 17)


def work_of_a_digest(number: int, changed: int) -> tuple[int, int]:
    """Return the calls and the most bytes that the digest of a map of ``number`` tiles takes after some changed."""
    shelf, numbers = Shelved(), np.arange(number, dtype=np.int32)
    digests = np.random.default_rng(number).integers(0, 256, (number, 16), np.uint8)
    with RoughMap(cell_size=1.0, error_model="point", levels=1, threads=1, shelf=shelf) as m:
        stamps = np.zeros(number, np.int64)
        m.load_shelved(numbers // 1000, numbers % 1000, stamps, stamps, digests, shelf.allocate(number))
        places = [(-64.0 * n - 1.0, 1.0, 1.0) for n in range(changed)]
        m.add(places)
        first = m.digest()
        m.add(places)
        calls: list[str] = []
        tracemalloc.start()
        sys.setprofile(lambda _frame, event, _argument: calls.append(event))
        try:
            assert m.digest() != first
        finally:
            sys.setprofile(None)
            most = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
    return len(calls), most


def test_what_a_digest_costs_does_not_depend_on_the_number_of_tiles() -> None:
    """The same calls for a thousand tiles and 100,000, and no array with a byte for each; more for more changes."""
    work_of_a_digest(1, 5)  # what is imported or cached at first
    few, _ = work_of_a_digest(1_000, 5)
    many, most = work_of_a_digest(100_000, 5)
    assert few == many
    assert most < 50_000
    assert work_of_a_digest(1_000, 10)[0] > few
