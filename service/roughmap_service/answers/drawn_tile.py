"""One state of a tile, drawn: the same bytes for every reader, except for two numbers of the attachment."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from roughmap.cell import TILE_CELLS
from roughmap_schemas.grid import encode_packed, packed_data
from roughmap_schemas.messages import TileInfo

_MEMBERS = list(TileInfo.model_fields)
MEMBERS_BEFORE = set(_MEMBERS[: _MEMBERS.index("map_sequence")])
MEMBERS_AFTER = set(_MEMBERS[_MEMBERS.index("answer_tiles") + 1 :])
"""The members of a `TileInfo` that belong to the tile; between them stand the two that belong to the answer."""

Values = npt.NDArray[np.floating[Any]]

WHOLE = slice(0, TILE_CELLS)


class DrawnTile:
    """One state of a tile: the values of its cells, and the messages made of them when they are first asked for.

    Regions need the values alone. Several threads may use a tile: two may make the same message at once.

    ``info``: its map_sequence and answer_tiles are 0, since they belong to an answer and not to the tile. ``values``:
    (64, 64, L) float32 or float64 of the layers ``names``. ``known``: one bit a cell, row by row, as `numpy.packbits`
    packs them. ``cell_size``: metres.
    """

    __slots__ = ("_json", "_known", "_names", "_payload", "_place", "_values", "info", "nbytes")

    def __init__(
        self, info: TileInfo, names: Sequence[str], values: Values, known: bytes, cell_size: float, frame_id: str
    ) -> None:
        self.info = info
        self.nbytes = values.nbytes
        """Bytes that the cells take in memory."""
        self._names = names
        self._values = values
        self._known = known
        self._place = cell_size, frame_id
        self._payload: bytes | None = None
        self._json: tuple[bytes, bytes] | None = None
        if info.compression is not None:
            self.nbytes = len(self.payload)

    @property
    def payload(self) -> bytes:
        """The bytes of its Grid."""
        if self._payload is None:
            info, (cell_size, frame_id), values = self.info, self._place, self._values
            x, y = info.x or 0, info.y or 0
            payload = encode_packed(
                self._names,
                values,
                (x * TILE_CELLS * cell_size, y * TILE_CELLS * cell_size),
                cell_size,
                info.newest_ns,
                frame_id,
                compression=info.compression,
            )
            kind: Literal["f4", "f8"] = "f4" if values.itemsize == 4 else "f8"
            self._payload = payload
            if info.compression is None:  # kept once
                self._values = packed_data(payload, (TILE_CELLS, TILE_CELLS, len(self._names)), kind)
            else:
                self._values = values[:0]
        return self._payload

    @property
    def values(self) -> Values:
        """The values of its cells, (64, 64, L); those of a compressed tile are not kept."""
        return self._values

    def attachment(self, map_sequence: int, answer_tiles: int) -> bytes:
        """Return the JSON of the `TileInfo` in one answer. Serialising the model for each reply would cost more than
        the rest of a cached reply."""
        if self._json is None:
            before, after = (
                self.info.model_dump_json(include=members).encode()[1:-1] for members in (MEMBERS_BEFORE, MEMBERS_AFTER)
            )
            self._json = before, after
        before, after = self._json
        return b'{%b,"map_sequence":%d,"answer_tiles":%d,%b}' % (before, map_sequence, answer_tiles, after)

    def info_in_answer(self, map_sequence: int, answer_tiles: int) -> TileInfo:
        """Return the same as a model."""
        return self.info.model_copy(update={"map_sequence": map_sequence, "answer_tiles": answer_tiles})

    def known_among(self, rows: slice, columns: slice) -> int:
        """Count the known cells of a part of the tile."""
        if rows == columns == WHOLE:
            return self.info.known_cells
        bits = np.unpackbits(np.frombuffer(self._known, np.uint8)).reshape(TILE_CELLS, TILE_CELLS)
        return int(np.count_nonzero(bits[rows, columns]))
