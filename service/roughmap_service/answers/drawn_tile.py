"""One state of a tile, encoded: the same bytes for every reader, except for two numbers of the attachment."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roughmap.cell import TILE_CELLS
from roughmap_schemas.messages import TileInfo

_MEMBERS = list(TileInfo.model_fields)
MEMBERS_BEFORE = set(_MEMBERS[: _MEMBERS.index("map_sequence")])
MEMBERS_AFTER = set(_MEMBERS[_MEMBERS.index("answer_tiles") + 1 :])
"""The members of a `TileInfo` that belong to the tile; between them stand the two that belong to the answer."""


@dataclass(frozen=True, slots=True, eq=False)
class DrawnTile:
    """One state of a tile: the bytes of its Grid and what its attachment is made from."""

    payload: bytes
    info: TileInfo
    """map_sequence and answer_tiles are 0: they belong to an answer and not to the tile."""
    members_before: bytes
    """JSON text of the info's members before those two, without braces."""
    members_after: bytes
    """JSON text of the info's members after those two, without braces."""
    known: bytes
    """One bit a cell, row by row, as `numpy.packbits` packs them."""

    def attachment(self, map_sequence: int, answer_tiles: int) -> bytes:
        """Return the JSON of the `TileInfo` in one answer. Serialising the model for each reply would cost more than
        the rest of a cached reply."""
        return b'{%b,"map_sequence":%d,"answer_tiles":%d,%b}' % (
            self.members_before, map_sequence, answer_tiles, self.members_after,
        )  # fmt: skip

    def info_in_answer(self, map_sequence: int, answer_tiles: int) -> TileInfo:
        """Return the same as a model."""
        return self.info.model_copy(update={"map_sequence": map_sequence, "answer_tiles": answer_tiles})

    def known_among(self, rows: slice, columns: slice) -> int:
        """Count the known cells of a part of the tile."""
        if rows == columns == slice(0, TILE_CELLS):
            return self.info.known_cells
        bits = np.unpackbits(np.frombuffer(self.known, np.uint8)).reshape(TILE_CELLS, TILE_CELLS)
        return int(np.count_nonzero(bits[rows, columns]))


def drawn_tile(payload: bytes, info: TileInfo, known: npt.NDArray[np.bool_]) -> DrawnTile:
    """Return a tile as drawn; ``info`` with map_sequence and answer_tiles 0, ``known`` (64, 64)."""
    before, after = (
        info.model_dump_json(include=members).encode()[1:-1] for members in (MEMBERS_BEFORE, MEMBERS_AFTER)
    )
    return DrawnTile(payload, info, before, after, np.packbits(known).tobytes())
