"""Grids: layers of tiles and regions on the wire."""

from typing import Literal

import numpy as np
import pytest
import zstandard
from contract_tools import MIB, STAMP, few, field, finite, frames, grid_message, many, refused, stamps
from foxglove_schemas_protobuf.Grid_pb2 import Grid as GridMessage
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from roughmap_schemas import LAYERS, decode_grid, encode_grid

shapes = st.tuples(st.integers(1, 9), st.integers(1, 9))
values64 = st.floats(allow_nan=True, allow_infinity=False)


@st.composite
def planes(draw: st.DrawFn) -> dict[str, np.ndarray]:
    shape = draw(shapes)
    names = draw(st.lists(st.sampled_from(LAYERS), min_size=1, max_size=4, unique=True))
    return {name: draw(hnp.arrays(np.float64, shape, elements=values64, fill=st.just(float("nan")))) for name in names}


@many
@given(planes(), st.tuples(finite, finite), st.floats(1e-6, 1e6), stamps, frames, st.sampled_from([None, "zstd"]))
def test_what_is_encoded_is_decoded(
    layers: dict, origin: tuple, side: float, stamp: int, frame: str, compression: str | None
) -> None:
    for dtype in ("f4", "f8"):
        got = decode_grid(encode_grid(layers, origin, side, stamp, frame, dtype, compression), compression)
        assert (got.origin, got.cell_size, got.stamp_ns, got.frame_id) == (origin, side, stamp, frame)
        assert list(got.layers) == list(layers)  # the asked order
        for name, plane in layers.items():
            with np.errstate(over="ignore"):
                np.testing.assert_array_equal(got.layers[name], plane.astype(f"<{dtype}"))  # NaN where NaN was
            assert got.layers[name].dtype == f"<{dtype}"


def test_rows_along_y_and_columns_along_x() -> None:
    """Two rows of three cells, two layers: what a foreign reader that knows only the schema finds."""
    plane = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    layers = {"range": plane, "mean_height": -plane}
    message = GridMessage.FromString(encode_grid(layers, (-6.4, 12.8), 0.2, STAMP, "map"))
    assert [(f.name, f.offset, f.type) for f in message.fields] == [("range", 0, 7), ("mean_height", 4, 7)]
    assert (message.column_count, message.cell_stride, message.row_stride) == (3, 8, 24)
    assert (message.pose.position.x, message.pose.position.y, message.pose.position.z) == (-6.4, 12.8, 0.0)
    assert (message.pose.orientation.x, message.pose.orientation.w) == (0.0, 1.0)
    assert (message.cell_size.x, message.cell_size.y, message.frame_id) == (0.2, 0.2, "map")
    assert message.timestamp.seconds * 10**9 + message.timestamp.nanos == STAMP
    assert np.frombuffer(message.data, "<f4").tolist() == [1, -1, 2, -2, 3, -3, 4, -4, 5, -5, 6, -6]


def test_only_the_data_is_compressed() -> None:
    layers = {"range": np.arange(64.0).reshape(8, 8)}
    plain = GridMessage.FromString(encode_grid(layers, (0, 0), 1.0, 0, "map"))
    packed = GridMessage.FromString(encode_grid(layers, (0, 0), 1.0, 0, "map", compression="zstd"))
    assert zstandard.ZstdDecompressor().decompress(packed.data) == plain.data
    packed.data = plain.data
    assert packed == plain


@pytest.mark.parametrize("side", [1, 4, 64])  # data of 1, 2 and 3 bytes of length
@pytest.mark.parametrize("compression", [None, "zstd"])
def test_the_bytes_are_protobufs_own(side: int, compression: Literal["zstd"] | None) -> None:
    payload = encode_grid({"range": np.ones((side, side))}, (1.0, -2.0), 0.1, STAMP, "map", compression=compression)
    assert GridMessage.FromString(payload).SerializeToString(deterministic=True) == payload


def test_a_foreign_grid_with_padding() -> None:
    got = decode_grid(grid_message().SerializeToString())
    assert (got.origin, got.cell_size, got.stamp_ns, got.frame_id) == ((-32.0, 64.0), 0.5, STAMP, "map")
    assert got.layers["mean_height"].tolist() == [[0, 0, 0], [10, 10, 10]]
    assert got.layers["range"].tolist() == [[0, 1, 2], [0, 1, 2]]
    assert not got.layers["range"].flags.writeable


@few
@given(st.floats(allow_nan=False))
def test_what_float32_cannot_hold_becomes_infinite(value: float) -> None:
    (got,) = decode_grid(encode_grid({"range": np.array([[value]])}, (0, 0), 1.0, 0, "map")).layers["range"][0]
    with np.errstate(over="ignore"):
        assert got == np.float32(value)


def set_strides(columns: int, cell: int, row: int) -> dict[str, int]:
    return {"column_count": columns, "cell_stride": cell, "row_stride": row}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (set_strides(0, 12, 44), ["columns within row_stride"]),
        (set_strides(3, 0, 44), ["columns within row_stride"]),
        (set_strides(3, 12, 0), ["columns within row_stride"]),
        (set_strides(3, 12, 35), ["columns within row_stride"]),
        (set_strides(4, 12, 44), ["columns within row_stride"]),
        (set_strides(2**32 - 1, 2**32 - 1, 2**32 - 1), ["columns within row_stride"]),
        (set_strides(3, 7, 44), ["fields", "mean_height"]),
        (set_strides(3, 12, 43), ["whole rows of 43"]),
        ({"data": b""}, ["whole rows", "found 0"]),
        ({"data": bytes(87)}, ["whole rows", "found 87"]),
    ],
)
def test_shapes_that_cannot_be(changes: dict, words: list[str]) -> None:
    message = grid_message()
    for name, value in changes.items():
        setattr(message, name, value)
    refused("bad_message", lambda: decode_grid(message.SerializeToString()), *words)


@pytest.mark.parametrize(
    "fields",
    [
        [],
        [field("range", 0, 7), field("range", 4, 7)],
        [field("range", 0, 6)],
        [field("range", 9, 7)],
        [field("range", 5, 8)],
        [field("range", 2**32 - 1, 7)],
    ],
)
def test_fields_that_cannot_be(fields: list) -> None:
    message = grid_message()
    del message.fields[:]
    message.fields.extend(fields)
    refused("bad_message", lambda: decode_grid(message.SerializeToString()), "foxglove.Grid.fields")


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (-1.0, -1.0), (1.0, 2.0), (np.nan, np.nan), (np.inf, np.inf)])
def test_cells_that_are_not_square(x: float, y: float) -> None:
    message = grid_message()
    message.cell_size.x, message.cell_size.y = x, y
    refused("bad_message", lambda: decode_grid(message.SerializeToString()), "square cells")


def packed(data: bytes) -> bytes:
    message = grid_message()
    message.data = data
    return message.SerializeToString()


def test_data_that_does_not_unpack() -> None:
    good = zstandard.ZstdCompressor().compress(grid_message().data)
    assert decode_grid(packed(good), "zstd").layers["range"].shape == (2, 3)
    unsaid = zstandard.ZstdCompressor(write_content_size=False).compress(grid_message().data)
    for data in (b"", b"no frame", good[:-1], good[:8], good + b"more", unsaid, grid_message().data):
        refused("bad_message", lambda data=data: decode_grid(packed(data), "zstd"), "data")


def test_what_a_frame_unpacks_to_is_checked_before() -> None:
    """A few kilobytes that would become 64 MiB."""
    bomb = zstandard.ZstdCompressor().compress(bytes(64 * MIB))
    refused("too_large", lambda: decode_grid(packed(bomb), "zstd", max_data=MIB), str(64 * MIB))
    refused("too_large", lambda: decode_grid(packed(grid_message().data), max_data=87), "found 88")


@pytest.mark.parametrize(
    "layers", [{}, {"range": np.zeros(4)}, {"range": np.zeros((2, 2)), "std_dev": np.zeros((2, 3))}]
)
def test_layers_of_no_common_shape_are_not_encoded(layers: dict) -> None:
    with pytest.raises(ValueError, match="all of one shape"):
        encode_grid(layers, (0, 0), 1.0, 0, "map")
