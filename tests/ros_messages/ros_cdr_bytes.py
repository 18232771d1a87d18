"""ROS messages written by hand, as the CDR specification has it: each number at a multiple of its own size."""

import struct
from collections.abc import Sequence

SIZES = {"b": 1, "B": 1, "H": 2, "i": 4, "I": 4, "f": 4, "Q": 8, "d": 8}


class Cdr:
    """Appends numbers, strings and bytes. Padding is 0xCD, for nobody may rely on zeros there."""

    def __init__(self, order: str = "<") -> None:
        self.order = order
        self.body = bytearray()

    def put(self, form: str, *values: float) -> "Cdr":
        for letter, value in zip(form, values, strict=True):
            self.body += b"\xcd" * (-len(self.body) % SIZES[letter])
            self.body += struct.pack(self.order + letter, value)
        return self

    def text(self, value: str) -> "Cdr":
        self.put("I", len(value.encode()) + 1)
        self.body += value.encode() + b"\0"
        return self

    def raw(self, data: bytes) -> "Cdr":
        self.put("I", len(data))
        self.body += data
        return self

    def header(self, stamp_ns: int, frame: str) -> "Cdr":
        return self.put("iI", *divmod(stamp_ns, 10**9)).text(frame)

    def bytes(self) -> bytes:
        return (b"\x00\x01" if self.order == "<" else b"\x00\x00") + b"\0\0" + bytes(self.body)


Field = tuple[str, int, int] | tuple[str, int, int, int]
"""Name, offset, datatype and count, 1 by default."""


def point_cloud(
    data: bytes,
    fields: Sequence[Field],
    step: int,
    width: int,
    height: int = 1,
    *,
    row_step: int | None = None,
    big_endian: bool = False,
    order: str = "<",
    stamp_ns: int = 12_000_000_034,
    frame: str = "lidar",
    dense: bool = True,
) -> bytes:
    cdr = Cdr(order).header(stamp_ns, frame).put("III", height, width, len(fields))
    for name, offset, datatype, *count in fields:
        cdr.text(name).put("IBI", offset, datatype, *(count or [1]))
    cdr.put("BII", big_endian, step, width * step if row_step is None else row_step)
    return cdr.raw(data).put("B", dense).bytes()


def livox(points: Sequence[Sequence[float]], timebase: int, stamp_ns: int, order: str = "<") -> bytes:
    """A CustomMsg of points (offset_time, x, y, z, reflectivity, tag, line)."""
    cdr = Cdr(order).header(stamp_ns, "livox_frame").put("QIBBBB", timebase, len(points), 1, 0, 0, 0)
    cdr.put("I", len(points))
    for point in points:
        cdr.put("IfffBBB", *point)
    return cdr.bytes()


def pose(cdr: Cdr, numbers: Sequence[float]) -> Cdr:
    return cdr.put("d" * len(numbers), *numbers)


def odometry(
    numbers: Sequence[float],
    *,
    stamp_ns: int = 12_000_000_034,
    frame: str = "odom",
    child: str = "base_link",
    order: str = "<",
) -> bytes:
    """An Odometry of 7 numbers of the pose and 36 of the covariance."""
    return pose(pose(Cdr(order).header(stamp_ns, frame).text(child), numbers), range(42)).bytes()


def tf_message(transforms: Sequence[tuple[int, str, str, Sequence[float]]], order: str = "<") -> bytes:
    cdr = Cdr(order).put("I", len(transforms))
    for stamp_ns, parent, child, numbers in transforms:
        pose(cdr.header(stamp_ns, parent).text(child), numbers)
    return cdr.bytes()
