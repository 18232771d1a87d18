"""Point clouds: ``foxglove.PointCloud`` from and to arrays."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from numpy.typing import ArrayLike, NDArray

from roughmap_schemas.faults import bad_message, too_large
from roughmap_schemas.geometry import (
    Quaternion,
    Vector,
    move,
    read_rotation,
    read_stamp,
    read_vector,
    write_rotation,
    write_stamp,
    write_vector,
)
from roughmap_schemas.point_times import TimeField
from roughmap_schemas.wire import LENGTH, check_outline, check_size, parse

WHAT: Final = "foxglove.PointCloud"
DATA_FIELD: Final = PointCloud.DATA_FIELD_NUMBER
UINT32, FLOAT32, FLOAT64 = PackedElementField.UINT32, PackedElementField.FLOAT32, PackedElementField.FLOAT64
COORDINATES: Final[dict[int, np.dtype[Any]]] = {FLOAT32: np.dtype("<f4"), FLOAT64: np.dtype("<f8")}
NUMBERS: Final[dict[int, np.dtype[Any]]] = {
    PackedElementField.UINT8: np.dtype("u1"),
    PackedElementField.INT8: np.dtype("i1"),
    PackedElementField.UINT16: np.dtype("<u2"),
    PackedElementField.INT16: np.dtype("<i2"),
    UINT32: np.dtype("<u4"),
    PackedElementField.INT32: np.dtype("<i4"),
    **COORDINATES,
}

MAX_FIELDS: Final = 64
"""Fields of a cloud that are kept beside x, y and z."""

MAX_FIELD_NAME: Final = 64
"""Characters of the name of a field that is kept."""

OBJECT_BYTES: Final = 1024
"""Memory of a cloud without points."""

IDENTITY: Final = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """A decoded cloud.

    ``points`` (N, 3) is float32 or float64, in metres in ``frame_id``. Usually it is a view of the payload, and then
    read-only, strided and not aligned. ``time_fields`` are the other fields, one of which may hold times. `timed` reads
    it: ``offsets_ns`` (N,) int64 are the points' times after ``stamp_ns``, -1 where invalid, None if there are none.
    """

    frame_id: str
    stamp_ns: int
    points: NDArray[np.floating[Any]]
    offsets_ns: NDArray[np.int64] | None = None
    time_fields: tuple[TimeField, ...] = ()

    def time_values(self, name: str) -> NDArray[Any] | None:
        """Return the values (N,) of the field with that name; None if there is none."""
        return next((field.values for field in self.time_fields if field.name == name), None)

    @property
    def held_bytes(self) -> int:
        """Bytes of memory held: the payload if points or fields are views of it, points of their own, and the times."""
        points = _owner(self.points)
        held = OBJECT_BYTES + (0 if self.offsets_ns is None else self.offsets_ns.nbytes) + _size(points)
        if self.time_fields and (fields := _owner(self.time_fields[0].values)) is not points:
            held += _size(fields)
        return held


def _owner(array: NDArray[Any]) -> NDArray[Any] | bytes:
    """Return the payload of which an array is a view, or the array that owns its memory."""
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array.base if isinstance(array.base, bytes) else array


def _size(owner: NDArray[Any] | bytes) -> int:
    return len(owner) if isinstance(owner, bytes) else owner.nbytes


def decode_cloud(payload: bytes, *, max_message: int, max_points: int, map_frame: str | None = None) -> Cloud:
    """Read a cloud; raises ``MessageFault`` (``too_large``, ``bad_message``).

    Size and layout are checked before any array is made. The message's pose is applied here, in float64. It does not
    move rows of (0, 0, 0), which mean that nothing came back, except in ``map_frame``. Times are not read: see `timed`.
    """
    check_size(payload, WHAT, max_message)
    # The points stay in the payload; only the other fields are parsed. As in protobuf, the last `data` counts.
    start = end = 0
    header = []
    for entry in check_outline(payload, PointCloud):
        if entry.number == DATA_FIELD and entry.wire == LENGTH:
            start, end = entry.start, entry.end
        else:
            header.append(payload[entry.tag : entry.end])
    message = parse(b"".join(header), PointCloud)

    stamp_ns = read_stamp(message, WHAT)
    stride = message.point_stride
    layout = _layout(message)
    if (end - start) % stride:
        raise bad_message(f"{WHAT}.data: expected a multiple of point_stride {stride}; found {end - start} bytes")
    count = (end - start) // stride
    if count > max_points:
        raise too_large(f"{WHAT}: expected at most {max_points} points; found {count}")

    points = layout.points(payload, start, count, stride)
    if message.HasField("pose"):
        translation = read_vector(message.pose.position, f"{WHAT}.pose.position")
        rotation = read_rotation(message.pose.orientation, f"{WHAT}.pose.orientation")
        if (translation, rotation) != IDENTITY:
            points = move(points, translation, rotation, keep_zero_rows=message.frame_id != map_frame)
    return Cloud(message.frame_id, stamp_ns, points, time_fields=layout.fields(payload, start, count, stride))


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where x, y, z and the other scalar fields lie within a point: a type and an offset each."""

    kind: int
    offsets: tuple[int, int, int]
    others: tuple[tuple[str, int, int], ...]

    def points(self, payload: bytes, start: int, count: int, stride: int) -> NDArray[np.floating[Any]]:
        """Return the coordinates (N, 3): a view if x, y, z are evenly spaced, else a copy."""
        dtype = COORDINATES[self.kind]
        if count == 0:
            return np.empty((0, 3), dtype)
        x, y, z = self.offsets
        if y - x == z - y:
            return np.ndarray((count, 3), dtype, payload, start + x, (stride, y - x))
        columns = [np.ndarray((count,), dtype, payload, start + offset, (stride,)) for offset in self.offsets]
        return np.stack(columns, axis=1)

    def fields(self, payload: bytes, start: int, count: int, stride: int) -> tuple[TimeField, ...]:
        """Return the other fields, as views."""
        if count == 0:
            return tuple(TimeField(name, np.empty(0, NUMBERS[kind])) for name, kind, _ in self.others)
        return tuple(
            TimeField(name, np.ndarray((count,), NUMBERS[kind], payload, start + offset, (stride,)))
            for name, kind, offset in self.others
        )


def _layout(message: Any) -> _Layout:
    """Check the fields x, y, z and t, and return the layout; other fields that can't be read are left out."""
    stride = message.point_stride
    found: dict[str, tuple[int, int]] = {}
    others: dict[str, tuple[int, int]] = {}
    for field in message.fields:
        if field.name in ("x", "y", "z", "t"):
            if field.name in found:
                raise bad_message(f"{WHAT}.fields: expected {field.name} once; found it twice")
            found[field.name] = (field.type, field.offset)
        elif (
            field.type in NUMBERS
            and field.offset + NUMBERS[field.type].itemsize <= stride
            and len(field.name) <= MAX_FIELD_NAME
            and len(others) < MAX_FIELDS
        ):
            others.setdefault(field.name, (field.type, field.offset))
    missing = [name for name in "xyz" if name not in found]
    if missing:
        names = [field.name[:20] for field in message.fields[:20]]
        raise bad_message(f"{WHAT}.fields: expected x, y and z; found {', '.join(names) or 'none'}")
    types = {found[name][0] for name in "xyz"}
    if len(types) != 1 or not types <= COORDINATES.keys():
        raise bad_message(
            f"{WHAT}.fields: expected x, y, z all FLOAT32 (7) or all FLOAT64 (8); "
            f"found {', '.join(str(found[name][0]) for name in 'xyz')}"
        )
    if "t" in found and found["t"][0] not in NUMBERS:
        raise bad_message(f"{WHAT}.fields: expected t of a numeric type (1 to 8); found {found['t'][0]}")
    if stride == 0:
        raise bad_message(f"{WHAT}.point_stride: expected at least 1; found 0")
    reached = 0
    for offset, size, name in sorted((offset, NUMBERS[kind].itemsize, name) for name, (kind, offset) in found.items()):
        if offset < reached:
            raise bad_message(
                f"{WHAT}.fields: expected fields that do not overlap; found {name} at {offset} over another one"
            )
        reached = offset + size
        if reached > stride:
            raise bad_message(f"{WHAT}.fields: expected {name} within point_stride {stride}; found bytes to {reached}")
    kind = types.pop()
    x, y, z = (found.pop(name)[1] for name in "xyz")
    return _Layout(kind, (x, y, z), tuple((name, *where) for name, where in (found | others).items()))


def encode_cloud(
    points: ArrayLike,
    stamp_ns: int,
    frame_id: str,
    offsets_ns: ArrayLike | None = None,
    pose: tuple[Vector, Quaternion] | None = None,
) -> bytes:
    """Return a cloud's payload; raises ValueError.

    ``points`` (N, 3) in metres: float64 stays float64, all else becomes float32. ``offsets_ns`` (N,) from 0 to below
    2^32. ``pose`` is the pose of the points' frame in ``frame_id``: position and quaternion x, y, z, w.
    """
    array = np.asarray(points)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"points: expected shape (N, 3), found {array.shape}")
    kind = FLOAT64 if array.dtype == np.float64 else FLOAT32
    dtype = COORDINATES[kind]
    message = PointCloud()
    write_stamp(message, stamp_ns)
    message.frame_id = frame_id
    if pose is not None:
        write_vector(message.pose.position, pose[0])
        write_rotation(message.pose.orientation, pose[1])
    for number, name in enumerate("xyz"):
        message.fields.append(PackedElementField(name=name, offset=number * dtype.itemsize, type=kind))
    if offsets_ns is None:
        message.point_stride = 3 * dtype.itemsize
        message.data = np.ascontiguousarray(array, dtype).tobytes()
    else:
        times = np.asarray(offsets_ns)
        if times.shape != (len(array),) or (len(times) and (times.min() < 0 or times.max() >= 2**32)):
            raise ValueError(f"offsets_ns: expected shape ({len(array)},) and values from 0 to below 2^32")
        packed = np.empty(len(array), np.dtype([("xyz", dtype, (3,)), ("t", "<u4")]))
        packed["xyz"], packed["t"] = array, times
        message.fields.append(PackedElementField(name="t", offset=3 * dtype.itemsize, type=UINT32))
        message.point_stride = packed.dtype.itemsize
        message.data = packed.tobytes()
    return bytes(message.SerializeToString())
