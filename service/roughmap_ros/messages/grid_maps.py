"""grid_map_msgs/GridMap from and to layers.

A layer of a GridMap is a matrix of float32 in column-major order: its first index falls along x and its second along y,
both from the highest. It is kept as a ring in both directions; the start indices say where it begins. The pose is the
grid's centre.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roughmap_ros.messages.cdr import CdrReader
from roughmap_ros.messages.poses import header_of, pose_of
from roughmap_ros.messages.types import GRID_MAP, TYPES, make

MAX_LAYERS: Final = 256
MAX_DIMENSIONS: Final = 16
LENGTH_TOLERANCE: Final = 0.5
"""How far a length may be from a whole number of cells, in cells: rounding decides."""


@dataclass(frozen=True, slots=True, eq=False)
class GridMapRead:
    """The layers of a GridMap: float32 (rows along y, columns along x), both from the lowest, NaN where unknown.

    ``origin`` is the low corner of the first cell in ``frame_id``, metres.
    """

    stamp_ns: int
    frame_id: str
    origin: tuple[float, float]
    cell_size: float
    layers: dict[str, npt.NDArray[np.float32]]
    basic_layers: tuple[str, ...]


def grid_map_cdr(
    layers: Mapping[str, npt.NDArray[Any]],
    origin: tuple[float, float],
    cell_size: float,
    stamp_ns: int,
    frame_id: str,
    basic_layers: Sequence[str],
) -> bytes:
    """Write a GridMap; the arguments are as in `GridMapRead`. At least one layer, all of one shape.

    A cell is known to grid_map if all its ``basic_layers`` are finite.
    """
    rows, columns = next(iter(layers.values())).shape
    length_x, length_y = columns * cell_size, rows * cell_size
    message = make(
        GRID_MAP,
        header=header_of(stamp_ns, frame_id),
        info=make(
            "grid_map_msgs/msg/GridMapInfo",
            resolution=cell_size,
            length_x=length_x,
            length_y=length_y,
            pose=pose_of(origin[0] + length_x / 2, origin[1] + length_y / 2),
        ),
        layers=list(layers),
        basic_layers=list(basic_layers),
        data=[_multi_array(layer) for layer in layers.values()],
        outer_start_index=0,
        inner_start_index=0,
    )
    return bytes(TYPES.serialize_cdr(message, GRID_MAP, little_endian=True))


def _multi_array(layer: npt.NDArray[Any]) -> object:
    rows, columns = layer.shape
    dimensions = [("column_index", rows, rows * columns), ("row_index", columns, columns)]
    # Column-major with x first is row-major with y first: the layer, turned by half a circle.
    return make(
        "std_msgs/msg/Float32MultiArray",
        layout=make(
            "std_msgs/msg/MultiArrayLayout",
            dim=[
                make("std_msgs/msg/MultiArrayDimension", label=label, size=size, stride=stride)
                for label, size, stride in dimensions
            ],
            data_offset=0,
        ),
        data=np.ascontiguousarray(layer[::-1, ::-1], np.float32).reshape(-1),
    )


def grid_map_arrays(cdr: bytes) -> GridMapRead:
    """Read a GridMap, in either storage order and with any start indices; raises ``BadRosMessage``."""
    reader = CdrReader(cdr, "grid_map_msgs/GridMap")
    header = reader.header()
    cell_size, length_x, length_y, x, y, _, *quaternion = reader.float64s(3 + 7)
    names = [reader.text() for _ in range(reader.count(MAX_LAYERS, "layers"))]
    basic = tuple(reader.text() for _ in range(reader.count(MAX_LAYERS, "basic layers")))
    number = reader.count(MAX_LAYERS, "arrays")
    if not (np.isfinite([cell_size, length_x, length_y, x, y]).all() and cell_size > 0.0):
        raise reader.bad(f"expected a resolution above 0, finite lengths and position; found {cell_size}, {x}, {y}")
    if quaternion[:3] != [0.0, 0.0, 0.0]:
        raise reader.bad(f"expected a grid that is not turned; found the quaternion {tuple(quaternion)}")
    if number != len(names):
        raise reader.bad(f"expected an array for each of {len(names)} layers; found {number}")
    matrices = [_matrix(reader, length_x / cell_size, length_y / cell_size) for _ in names]
    outer, inner = reader.uint16(), reader.uint16()
    reader.end()

    # grid_map names the start along x "outer" and that along y "inner".
    layers = {
        name: np.ascontiguousarray(np.roll(matrix, (-outer, -inner), (0, 1)).T[::-1, ::-1])
        for name, matrix in zip(names, matrices, strict=True)
    }
    origin = (x - length_x / 2, y - length_y / 2)
    return GridMapRead(header.stamp_ns, header.frame_id, origin, cell_size, layers, basic)


def _matrix(reader: CdrReader, cells_x: float, cells_y: float) -> npt.NDArray[np.float32]:
    """Read a layer as (cells along x, cells along y), both from the highest but for the start indices."""
    dimensions = []
    for _ in range(reader.count(MAX_DIMENSIONS, "dimensions")):
        dimensions.append((reader.text(), reader.uint32()))
        reader.uint32()  # the stride follows from the sizes
    start = reader.uint32()
    values = np.frombuffer(reader.array(4), reader.order + "f4")[start:].astype(np.float32)
    shape = tuple(size for _, size in dimensions)
    if len(shape) != 2 or shape[0] * shape[1] != len(values):
        raise reader.bad(f"expected a layer of two dimensions; found {shape} with {len(values)} numbers")
    by_rows = dimensions[0][0] == "row_index"
    matrix = values.reshape(shape) if by_rows else values.reshape(shape).T
    if abs(matrix.shape[0] - cells_x) > LENGTH_TOLERANCE or abs(matrix.shape[1] - cells_y) > LENGTH_TOLERANCE:
        raise reader.bad(f"expected {cells_x:g} x {cells_y:g} cells along x and y; found {matrix.shape}")
    return matrix
