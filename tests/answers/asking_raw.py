"""Asking as a stranger does who knows the contract alone: Zenoh, Foxglove's protobuf, JSON and numpy."""

import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import zenoh
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from net import WAIT_S

NUMPY = {7: np.dtype("<f4"), 8: np.dtype("<f8")}


@dataclass
class Replies:
    """All that came to one query."""

    ok: list[zenoh.Sample] = field(default_factory=list)
    errors: list[dict[str, str]] = field(default_factory=list)

    def tiles(self) -> dict[tuple[int, int, int], "RawTile"]:
        """Tiles by level, x and y; no error may have come."""
        assert self.errors == []
        tiles = [RawTile(sample) for sample in self.ok]
        by_key = {tile.key: tile for tile in tiles}
        assert len(by_key) == len(tiles), "no tile answers twice"
        return by_key

    def error(self) -> str:
        """The code of the one error reply that is all of the answer."""
        assert self.ok == []
        (error,) = self.errors
        assert set(error) == {"contract", "code", "message"}
        assert error["message"]
        return error["code"]

    def json(self) -> Any:
        """The one reply, in JSON without NaN."""
        assert self.errors == []
        (sample,) = self.ok
        return json.loads(sample.payload.to_bytes(), parse_constant=_refused)


def _refused(name: str) -> None:
    raise AssertionError(f"{name} in JSON")


class RawTile:
    """A tile reply, taken apart by Foxglove's schema."""

    def __init__(self, sample: zenoh.Sample) -> None:
        assert str(sample.encoding) == "application/protobuf;foxglove.Grid"
        self.name = str(sample.key_expr)
        self.grid = Grid.FromString(sample.payload.to_bytes())
        assert sample.attachment is not None
        self.info = json.loads(sample.attachment.to_bytes(), parse_constant=_refused)
        self.key = (self.info["z"], self.info["x"], self.info["y"])
        self.stamp_ns = self.grid.timestamp.seconds * 10**9 + self.grid.timestamp.nanos

    def layers(self, data: bytes | None = None) -> dict[str, np.ndarray]:
        """Each layer (rows, columns); `data` stands for the grid's where that is compressed."""
        grid = self.grid
        data = grid.data if data is None else data
        assert len(data) % grid.row_stride == 0
        shape = len(data) // grid.row_stride, grid.column_count
        return {
            f.name: np.ndarray(shape, NUMPY[f.type], data, f.offset, (grid.row_stride, grid.cell_stride))
            for f in grid.fields
        }


def get(session: zenoh.Session, selector: str, payload: bytes | None = None) -> Replies:
    """Asks and waits for all replies."""
    replies = Replies()
    for reply in session.get(
        selector, payload=payload, consolidation=zenoh.ConsolidationMode.NONE, timeout=WAIT_S
    ):  # fmt: skip
        if reply.ok is not None:
            replies.ok.append(reply.ok)
        else:
            assert reply.err is not None
            assert str(reply.err.encoding) == "application/json;roughmap.QueryError"
            replies.errors.append(json.loads(reply.err.payload.to_bytes()))
    return replies
