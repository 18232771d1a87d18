"""sensor_msgs/PointCloud2 to ``foxglove.PointCloud``.

Little-endian points without padding between rows are the same bytes in both, so they are copied once, as a whole.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

from roughmap_ros.messages.cdr import CdrReader, Header
from roughmap_schemas.cloud import DATA_FIELD
from roughmap_schemas.geometry import write_stamp
from roughmap_schemas.kinds import Kind, RobotMessage
from roughmap_schemas.wire import LENGTH, write_varint

WHAT: Final = "sensor_msgs/PointCloud2"

MAX_FIELDS: Final = 64
"""Fields of a point; drivers have up to a dozen."""

MAX_STEP: Final = 65535
"""Bytes of a point; drivers have up to a hundred."""

XYZ: Final = ("x", "y", "z")

DATA_TAG: Final = write_varint(DATA_FIELD << 3 | LENGTH)


class Number(NamedTuple):
    """A type of numbers: its form in numpy, without byte order, and its code in a ``PackedElementField``."""

    form: str
    code: PackedElementField.NumericType.ValueType

    @property
    def size(self) -> int:
        """Bytes of a number."""
        return int(self.form[1:])


FLOAT32: Final = Number("f4", PackedElementField.FLOAT32)
FLOAT64: Final = Number("f8", PackedElementField.FLOAT64)
NUMBERS: Final = {
    1: Number("i1", PackedElementField.INT8),
    2: Number("u1", PackedElementField.UINT8),
    3: Number("i2", PackedElementField.INT16),
    4: Number("u2", PackedElementField.UINT16),
    5: Number("i4", PackedElementField.INT32),
    6: Number("u4", PackedElementField.UINT32),
    7: FLOAT32,
    8: FLOAT64,
}
"""By a PointField's ``datatype``."""


class PlacedField(NamedTuple):
    """A number of a point: its name, where it lies in the point, its type."""

    name: str
    offset: int
    number: Number


def cloud_message(cdr: bytes, log_ns: int) -> RobotMessage:
    """Turn a PointCloud2 into a message of the contract; raises ``BadRosMessage``.

    Kept: stamp, frame, and the fields of one number each with their names and types, the times among them. x, y and z
    must be float32 or float64. Points keep their order, row by row. Fields of several numbers, of an unknown type or
    beyond the point's end are left out.
    """
    reader = CdrReader(cdr, WHAT)
    header = reader.header()
    height, width = reader.uint32(), reader.uint32()
    fields = _fields(reader)
    big_endian = bool(reader.uint8())
    step, row_step = reader.uint32(), reader.uint32()
    data = reader.array(1)
    reader.uint8()  # is_dense: points that are not finite are known by themselves
    reader.end()

    fields = _usable(reader, fields, step)
    if not height * width:
        height, width, data = 0, 0, data[:0]
    row_step = _row_step(reader, len(data), height, width, step, row_step)
    if big_endian or row_step != width * step or _differ(fields):
        form = record(fields, ">" if big_endian else "<", step)
        points = np.ndarray((height, width), form, data, 0, (row_step, step))
        payload = converted_payload(header, fields, points)
    else:
        payload = cloud_payload(header, fields, step, data[: height * width * step])
    return RobotMessage(Kind.POINTS, payload, log_ns)


def cloud_payload(header: Header, fields: Sequence[PlacedField], step: int, *data: bytes | memoryview) -> bytes:
    """Return the payload of a cloud: ``data`` are its points' bytes, little-endian, ``step`` bytes each."""
    message = PointCloud(frame_id=header.frame_id, point_stride=step)
    write_stamp(message, header.stamp_ns)
    for field in fields:
        message.fields.append(PackedElementField(name=field.name, offset=field.offset, type=field.number.code))
    size = write_varint(sum(len(part) for part in data))
    return b"".join([message.SerializeToString(), DATA_TAG, size, *data])


def converted_payload(header: Header, fields: Sequence[PlacedField], given: npt.NDArray[np.void]) -> bytes:
    """Return the payload of a cloud whose points must be written anew.

    ``given`` has a record for each point, of any shape, strides and byte order, whose members are the ``fields`` in
    their order. They keep their places and types, but x, y and z follow behind the point as float64 if their types
    differ.
    """
    placed, size = list(fields), given.itemsize
    if _differ(fields):
        for n, field in enumerate(fields):
            if field.name in XYZ:
                placed[n] = PlacedField(field.name, size, FLOAT64)
                size += FLOAT64.size
    points = np.zeros(given.shape, record(placed, "<", size))
    with np.errstate(invalid="ignore"):  # of NaNs of any bits
        for name in given.dtype.names or ():
            points[name] = given[name]
    return cloud_payload(header, placed, size, points.reshape(-1).view(np.uint8).data)


def _differ(fields: Sequence[PlacedField]) -> bool:
    """Tell whether x, y and z are not of one type."""
    return len({field.number for field in fields if field.name in XYZ}) > 1


def record(fields: Sequence[PlacedField], order: str, step: int) -> np.dtype[np.void]:
    """Return the form of a point in numpy. Its members have names of ours: a cloud's may be empty."""
    return np.dtype(
        {
            "names": [f"f{n}" for n in range(len(fields))],
            "formats": [order + field.number.form for field in fields],
            "offsets": [field.offset for field in fields],
            "itemsize": step,
        }
    )


def _fields(reader: CdrReader) -> list[PlacedField]:
    """Read the fields; those that are one number of a known type are kept."""
    found = []
    for _ in range(reader.count(MAX_FIELDS, "fields")):
        name, offset = reader.text(), reader.uint32()
        number, count = NUMBERS.get(reader.uint8()), reader.uint32()
        if number is not None and count <= 1:  # some drivers write 0 where there is one
            found.append(PlacedField(name, offset, number))
    return found


def _usable(reader: CdrReader, fields: list[PlacedField], step: int) -> list[PlacedField]:
    """Leave out fields beyond the point's end and second ones of a name; check x, y and z."""
    if step > MAX_STEP:
        raise reader.bad(f"expected a point_step of at most {MAX_STEP} bytes; found {step}")
    kept: dict[str, PlacedField] = {}
    for field in fields:
        if field.offset + field.number.size <= step:
            kept.setdefault(field.name, field)
    reached = 0
    # The contract lets no field lie over x, y, z or t.
    for field in sorted((kept[name] for name in (*XYZ, "t") if name in kept), key=lambda f: f.offset):
        if field.offset < reached:
            raise reader.bad(f"expected x, y, z and t apart; found {field.name} at {field.offset} over another one")
        reached = field.offset + field.number.size
    xyz = [kept[name].number for name in XYZ if name in kept]
    if len(xyz) < 3:
        names = ", ".join(field.name[:20] for field in list(kept.values())[:10]) or "none"
        raise reader.bad(f"expected fields x, y and z within point_step {step}; found {names}")
    if any(number not in (FLOAT32, FLOAT64) for number in xyz):
        raise reader.bad(f"expected x, y, z as float32 (7) or float64 (8); found {', '.join(n.form for n in xyz)}")
    return list(kept.values())


def _row_step(reader: CdrReader, size: int, height: int, width: int, step: int, row_step: int) -> int:
    """Return the bytes from one row to the next. Where ``size`` bytes are just the points, there is no padding."""
    row = width * step
    if size == height * row or (height == 1 and size > row):
        return row
    if row_step >= row and size >= (height - 1) * row_step + row:
        return row_step
    raise reader.bad(
        f"expected {height} x {width} points of {step} bytes, a row every {row_step} bytes; found {size} bytes of data"
    )
