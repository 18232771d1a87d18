"""The digest, computed independently from the records as the contract defines it."""

import struct

import numpy as np
import pytest
import xxhash
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import MODELS, cells_of, clouds

from roughmap import CELL_DTYPE, RoughMap
from roughmap.tiles.digest import map_digest

FIELDS = ("count", "updated", "weight", "weight_sq", "mean", "m2", "min", "max", "inv_cf")


def by_the_contract(m: RoughMap) -> str:
    """Compute the digest from the known cells, packed field by field; all other cells are 64 zero bytes."""
    tiles: dict[tuple[int, int], bytearray] = {}
    for (i, j), cell in cells_of(m).items():
        records = tiles.setdefault((i >> 6, j >> 6), bytearray(64 * 4096))
        place = 64 * ((j & 63) * 64 + (i & 63))
        records[place : place + 64] = struct.pack("<II7d", *(cell[name].item() for name in FIELDS))
    whole = b""
    for (tx, ty), records in sorted(tiles.items()):
        number = xxhash.xxh3_128_intdigest(bytes(records))
        whole += struct.pack("<ii", tx, ty) + number.to_bytes(16, "big")
    return xxhash.xxh3_128_hexdigest(whole)


def test_the_record() -> None:
    assert CELL_DTYPE.itemsize == 64
    assert CELL_DTYPE.names == FIELDS
    assert [CELL_DTYPE[name].str for name in FIELDS] == ["<u4", "<u4"] + ["<f8"] * 7
    assert [CELL_DTYPE.fields[name][1] for name in FIELDS] == [0, 4, 8, 16, 24, 32, 40, 48, 56]


@settings(deadline=None, max_examples=60)
@given(cloud=clouds(), model=st.sampled_from(MODELS), cuts=st.integers(1, 3))
def test_any_map(cloud: tuple[np.ndarray, np.ndarray, np.ndarray], model: str, cuts: int) -> None:
    """The digest is checked after each call, so that a stale cached digest would show."""
    points, S, stamps = cloud
    m = RoughMap(error_model=model, threads=1)
    for part in np.array_split(np.arange(len(points)), cuts):
        m.add(points[part], S[part], stamps[part])
        assert m.digest() == by_the_contract(m)


def test_tiles_are_sorted_as_signed_numbers() -> None:
    """As unsigned numbers -1 would come last, and as little-endian bytes 256 before 1."""
    m = RoughMap(cell_size=1.0, error_model="point", threads=1)
    places = [(1, -1), (-1, 0), (0, 256), (0, 1), (0, -2), (256, 0), (-(2**25), 5), (2**25 - 1, -7)]
    m.add([(64.0 * x, 64.0 * y, 1.0) for x, y in places])
    tx, ty, digests = m.tile_digests()
    assert list(zip(tx.tolist(), ty.tolist(), strict=True)) == sorted(places)
    assert digests.shape == (8, 16)
    assert m.digest() == by_the_contract(m)


def test_an_empty_map_and_a_reset_one() -> None:
    m = RoughMap(error_model="point", threads=1)
    assert m.digest() == xxhash.xxh3_128_hexdigest(b"")
    m.add([(0.0, 0.0, 1.0)])
    assert m.digest() != xxhash.xxh3_128_hexdigest(b"")
    m.reset()
    assert m.digest() == xxhash.xxh3_128_hexdigest(b"")
    assert m.sequence == 2


@pytest.mark.parametrize("other", [{"height": 1.0 + 2**-52}, {"x": 0.15}, {"y": -0.05}, {"stamp_s": 4}, {"times": 2}])
def test_any_difference_shows(other: dict[str, float]) -> None:
    def digest(height: float = 1.0, x: float = 0.05, y: float = 0.05, stamp_s: int = 3, times: int = 1) -> str:
        m = RoughMap(error_model="point", threads=1)
        m.add([(x, y, height)] * times, stamp_ns=stamp_s * 10**9)
        return m.digest()

    assert digest(**other) != digest()


def test_stamps_within_a_second_and_sequences_do_not_count() -> None:
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
            copy.load_tile(x, y, frozen.records(x, y).reshape(-1), 0, 0, digest.tobytes())
    assert copy.digest() == m.digest()
    # A change discards the stored digest.
    m.add([(0.05, 0.05, 1.0)])
    copy.add([(0.05, 0.05, 1.0)])
    assert copy.digest() == m.digest() == by_the_contract(copy)


def test_the_digest_is_made_once_after_each_change(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    monkeypatch.setattr("roughmap.map.map_digest", lambda *tiles: made.append(tiles) or map_digest(*tiles))
    m = RoughMap(error_model="point", threads=1)
    changes = [
        lambda: m.add([(0.05, 0.05, 1.0)]),
        m.reset,
        lambda: m.load_tile(3, 3, np.full(4096, np.array(1, CELL_DTYPE)), 0, 0),
        lambda: m.add([(0.05, 0.05, 1.0)]),
    ]
    for number, change in enumerate(changes, 1):
        change()
        assert m.digest() == m.digest() == by_the_contract(m)
        assert len(made) == number
