"""Digests of tiles and of the map."""

import numpy as np
import xxhash

from roughmap.arrays import I4, U1, Records


def tile_digest(records: Records) -> bytes:
    """Return the XXH3-128 of a tile's 4096 records, j outer, i inner, as 16 big-endian bytes."""
    return xxhash.xxh3_128_digest(np.ascontiguousarray(records).reshape(-1).view(np.uint8).data)


def map_digest(tx: I4, ty: I4, digests: U1) -> str:
    """Return the XXH3-128, in hex, of the map: over (tx i4, ty i4, digest 16 bytes), little-endian, for each tile.

    The tiles are in ascending order of signed (tx, ty).
    """
    rows = np.zeros(len(tx), [("tx", "<i4"), ("ty", "<i4"), ("digest", "u1", 16)])
    rows["tx"] = tx
    rows["ty"] = ty
    rows["digest"] = digests
    return xxhash.xxh3_128_hexdigest(rows.tobytes())
