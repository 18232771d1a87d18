"""Point clouds: ``foxglove.PointCloud`` from and to arrays."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from numpy.typing import ArrayLike, NDArray

from roughmap_schemas.faults import bad_message, too_large
from roughmap_schemas.geometry import (
    SECOND_NS,
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
from roughmap_schemas.wire import LENGTH, check_outline, check_size, parse

WHAT: Final = "foxglove.PointCloud"
DATA_FIELD: Final = PointCloud.DATA_FIELD_NUMBER
UINT32, FLOAT32, FLOAT64 = PackedElementField.UINT32, PackedElementField.FLOAT32, PackedElementField.FLOAT64
COORDINATES: Final[dict[int, np.dtype[Any]]] = {FLOAT32: np.dtype("<f4"), FLOAT64: np.dtype("<f8")}
TIMES: Final[dict[int, np.dtype[Any]]] = {UINT32: np.dtype("<u4"), **COORDINATES}
BAD_OFFSET: Final = -1
"""Marks an invalid time of a point: negative, beyond 1 s, or NaN. The map rejects such points as `time`."""

OBJECT_BYTES: Final = 1024
"""Memory of a cloud without points."""

IDENTITY: Final = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """A decoded cloud.

    ``points`` (N, 3) is float32 or float64, in metres in ``frame_id``. Usually it is a view of the payload, and then
    read-only, strided and not aligned. ``offsets_ns`` (N,) int64 are the points' times after ``stamp_ns``, -1 where
    invalid; None if the cloud has no times.
    """

    frame_id: str
    stamp_ns: int
    points: NDArray[np.floating[Any]]
    offsets_ns: NDArray[np.int64] | None

    @property
    def held_bytes(self) -> int:
        """Bytes of memory held: the payload if the points are a view of it, else the points; and the times."""
        array = self.points
        while isinstance(array.base, np.ndarray):
            array = array.base
        points = len(array.base) if isinstance(array.base, bytes) else array.nbytes
        return OBJECT_BYTES + points + (0 if self.offsets_ns is None else self.offsets_ns.nbytes)


def decode_cloud(payload: bytes, *, max_message: int, max_points: int, map_frame: str | None = None) -> Cloud:
    """Read a cloud; raises ``MessageFault`` (``too_large``, ``bad_message``).

    Size and layout are checked before any array is made. The message's pose is applied here, in float64. It does not
    move rows of (0, 0, 0), which mean that nothing came back, except in ``map_frame``.
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
    return Cloud(message.frame_id, stamp_ns, points, layout.offsets_ns(payload, start, count, stride))


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where x, y, z and the optional t lie within a point."""

    kind: int
    offsets: tuple[int, int, int]
    time: tuple[int, int] | None
    """The type and offset of t."""

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

    def offsets_ns(self, payload: bytes, start: int, count: int, stride: int) -> NDArray[np.int64] | None:
        if self.time is None:
            return None
        kind, offset = self.time
        if count == 0:
            return np.empty(0, np.int64)
        given = np.ndarray((count,), TIMES[kind], payload, start + offset, (stride,))
        if kind == UINT32:
            whole = given.astype(np.int64)
            whole[whole > SECOND_NS] = BAD_OFFSET
            return whole
        seconds = given.astype(np.float64)
        with np.errstate(invalid="ignore"):
            good = (seconds >= 0.0) & (seconds <= 1.0)  # false for NaN
        return np.where(good, np.rint(np.where(good, seconds, 0.0) * 1e9), BAD_OFFSET).astype(np.int64)


def _layout(message: Any) -> _Layout:
    """Check the fields x, y, z and t, and return their layout; other fields are ignored."""
    stride = message.point_stride
    found: dict[str, tuple[int, int]] = {}
    for field in message.fields:
        if field.name not in ("x", "y", "z", "t"):
            continue
        if field.name in found:
            raise bad_message(f"{WHAT}.fields: expected {field.name} once; found it twice")
        found[field.name] = (field.type, field.offset)
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
    if "t" in found and found["t"][0] not in TIMES:
        raise bad_message(f"{WHAT}.fields: expected t as UINT32 (5), FLOAT32 (7) or FLOAT64 (8); found {found['t'][0]}")
    if stride == 0:
        raise bad_message(f"{WHAT}.point_stride: expected at least 1; found 0")
    reached = 0
    for offset, size, name in sorted((offset, TIMES[kind].itemsize, name) for name, (kind, offset) in found.items()):
        if offset < reached:
            raise bad_message(
                f"{WHAT}.fields: expected fields that do not overlap; found {name} at {offset} over another one"
            )
        reached = offset + size
        if reached > stride:
            raise bad_message(f"{WHAT}.fields: expected {name} within point_stride {stride}; found bytes to {reached}")
    kind = types.pop()
    return _Layout(kind, (found["x"][1], found["y"][1], found["z"][1]), found.get("t"))


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
