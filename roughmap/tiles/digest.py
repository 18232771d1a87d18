"""Digests of tiles and of the map."""

import numpy as np
import xxhash

from roughmap.arrays import I4, U1
from roughmap.tiles.index import LevelIndex, grown, kept_rows
from roughmap.tiles.state import TileState

_TILE = np.dtype([("tx", "<i4"), ("ty", "<i4"), ("digest", "u1", 16)])
_MASK = (1 << 128) - 1


def tile_digest(state: TileState) -> bytes:
    """Return the XXH3-128 of a tile's cells, trust and column, if it has one, as 16 big-endian bytes."""
    digest = xxhash.xxh3_128()
    for array in state.arrays:
        digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return digest.digest()


def digest_sum(tx: I4, ty: I4, digests: U1) -> int:
    """Return the sum over (T,) tiles of XXH3-128(tx i4, ty i4, digest 16 bytes), little-endian; modulo 2^128."""
    rows = np.empty(len(tx), _TILE)
    rows["tx"], rows["ty"], rows["digest"] = tx, ty, digests
    data, size = rows.tobytes(), _TILE.itemsize
    hashed = xxhash.xxh3_128_intdigest
    return sum(hashed(data[start : start + size]) for start in range(0, len(data), size)) & _MASK


def map_digest(number: int, total: int) -> str:
    """Return the XXH3-128, in hex, of a map: over the number of tiles (8 bytes) and their `digest_sum` (16 bytes).

    Both little-endian.
    """
    return xxhash.xxh3_128_hexdigest(number.to_bytes(8, "little") + total.to_bytes(16, "little"))


class TileDigests:
    """The digests of the tiles of an index, by entry, and their `digest_sum`, which costs only what has changed.

    Attributes:
        digest: (T, 16), the last digest of each entry.
        known: (T,), whether it is the present one. A reader sees a digest complete or as not known.
        outdated: the entries without their present digest.
        total: the sum of the last digests of all entries that have one.
    """

    def __init__(self, index: LevelIndex) -> None:
        self.digest = np.zeros((0, 16), np.uint8)
        self.known = np.zeros(0, np.bool_)
        self.outdated: set[int] = set()
        self.total = 0
        self._summed = np.zeros(0, np.bool_)
        self._index = index

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return self.digest.nbytes + self.known.nbytes + self._summed.nbytes

    def reserve(self, capacity: int) -> None:
        """Make room for ``capacity`` entries; MemoryError, and no change, if that fails."""
        digest, known, summed = grown(self.digest, capacity), grown(self.known, capacity), grown(self._summed, capacity)
        self.digest, self.known, self._summed = digest, known, summed

    def add(self, entries: I4) -> None:
        """Add new entries, without a digest."""
        self.outdated.update(entries.tolist())

    def outdate(self, entries: I4) -> None:
        """Discard the digests of entries that have changed."""
        lost = entries[self.known[entries]]
        self.known[lost] = False
        self.outdated.update(lost.tolist())

    def set(self, entries: I4, digests: U1) -> None:
        """Set the present digests of (T,) different entries to ``digests`` (T, 16)."""
        total = self.total - self._sum(entries[self._summed[entries]])
        self.digest[entries] = digests
        self.known[entries] = self._summed[entries] = True
        self.total = (total + self._sum(entries)) & _MASK
        self.outdated.difference_update(entries.tolist())

    def only(self, kept: I4, index: LevelIndex) -> "TileDigests":
        """Return the digests of the entries ``kept`` alone, for the index made of them by `LevelIndex.only`."""
        gone = self._summed[: self._index.size].copy()
        gone[kept] = False
        digests = TileDigests(index)
        digests.digest, digests.known = kept_rows(self.digest, kept), kept_rows(self.known, kept)
        digests._summed = kept_rows(self._summed, kept)
        digests.outdated = set(np.flatnonzero(~digests.known[: len(kept)]).tolist())
        digests.total = (self.total - self._sum(np.flatnonzero(gone).astype(np.int32))) & _MASK
        return digests

    def _sum(self, entries: I4) -> int:
        return digest_sum(self._index.tx[entries], self._index.ty[entries], self.digest[entries])
