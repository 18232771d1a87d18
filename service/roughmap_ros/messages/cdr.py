"""Reads CDR, the form of ROS 2's messages on the wire and in bags, in either byte order.

Nothing is allocated before its length was compared with the bytes that are there, and every list has a limit.
"""

from struct import unpack_from
from typing import Final, NamedTuple

from roughmap_schemas.faults import ReportedError
from roughmap_schemas.geometry import SECOND_NS

HEADER_BYTES: Final = 4
"""Two bytes that name the representation, and two of options. Alignment counts from after them."""

BIG_ENDIAN: Final = b"\x00\x00"
LITTLE_ENDIAN: Final = b"\x00\x01"

PADDING: Final = 3
"""Most bytes after the last field: DDS fills up to a multiple of four."""

MAX_TEXT: Final = 256
"""Bytes of a name: of a frame, a field or a layer."""


class BadRosMessage(ReportedError):
    """A ROS message that can't be used; one line that says what was expected and what was found."""


class Header(NamedTuple):
    """A std_msgs/Header: ``stamp_ns`` since the Unix epoch; the frame's name without the first slash of ROS 1."""

    stamp_ns: int
    frame_id: str


class CdrReader:
    """Reads one message, field after field. ``what`` names it in errors; all methods raise ``BadRosMessage``."""

    def __init__(self, cdr: bytes | memoryview, what: str) -> None:
        start = bytes(cdr[:HEADER_BYTES])
        if len(start) < HEADER_BYTES or start[:2] not in (LITTLE_ENDIAN, BIG_ENDIAN):
            found = start[:2].hex(" ") or "no bytes"
            raise BadRosMessage(f"{what}: expected CDR, which begins with 00 01 or 00 00; found {found}")
        self.order = "<" if start[:2] == LITTLE_ENDIAN else ">"
        self.what = what
        self._cdr = cdr
        self._at = HEADER_BYTES

    def bad(self, text: str) -> BadRosMessage:
        """Return the error for this message."""
        return BadRosMessage(f"{self.what}: {text}")

    def skip(self, size: int, align: int = 1) -> int:
        """Go on past ``size`` bytes that are aligned to ``align``, and return where they begin."""
        at = self._at + (HEADER_BYTES - self._at) % align
        if at + size > len(self._cdr):
            raise self.bad(f"expected {size} bytes at byte {at}; found {max(len(self._cdr) - at, 0)}")
        self._at = at + size
        return at

    def uint8(self) -> int:
        """Read one byte."""
        return self._cdr[self.skip(1)]

    def uint16(self) -> int:
        """Read a uint16."""
        return int(unpack_from(self.order + "H", self._cdr, self.skip(2, 2))[0])

    def uint32(self) -> int:
        """Read a uint32."""
        return int(unpack_from(self.order + "I", self._cdr, self.skip(4, 4))[0])

    def uint64(self) -> int:
        """Read a uint64."""
        return int(unpack_from(self.order + "Q", self._cdr, self.skip(8, 8))[0])

    def float64s(self, count: int) -> tuple[float, ...]:
        """Read so many float64."""
        return unpack_from(f"{self.order}{count}d", self._cdr, self.skip(8 * count, 8))

    def text(self) -> str:
        """Read a string."""
        size = self.uint32()
        if size > MAX_TEXT + 1:
            raise self.bad(f"expected a name of at most {MAX_TEXT} bytes at byte {self._at}; found {size}")
        at = self.skip(size)
        value = bytes(self._cdr[at : at + size])
        if size and value[-1]:
            raise self.bad(f"expected a string that ends with 0 at byte {at + size - 1}; found {value[-1]}")
        try:
            return value[:-1].decode()
        except UnicodeDecodeError:
            raise self.bad(f"expected UTF-8 at byte {at}; found other bytes") from None

    def count(self, most: int, of: str) -> int:
        """Read the length of a list of objects; refuse one of more than ``most``."""
        number = self.uint32()
        if number > most:
            raise self.bad(f"expected at most {most} {of}; found {number}")
        return number

    def array(self, itemsize: int) -> memoryview:
        """Read a list of numbers of ``itemsize`` bytes each, as a view of their bytes."""
        number = self.uint32()
        size = number * itemsize
        at = self.skip(size, itemsize) if number else self._at
        return memoryview(self._cdr)[at : at + size]

    def stamp_ns(self) -> int:
        """Read a time."""
        seconds, nanos = unpack_from(self.order + "iI", self._cdr, self.skip(8, 4))
        if seconds < 0 or nanos >= SECOND_NS:
            raise self.bad(f"expected a stamp with sec from 0 and nanosec below 10^9; found {seconds} s {nanos} ns")
        return int(seconds) * SECOND_NS + int(nanos)

    def frame(self) -> str:
        """Read the name of a frame, and take off the first slash that ROS 1 had there."""
        return self.text().lstrip("/")

    def header(self) -> Header:
        """Read a std_msgs/Header."""
        return Header(self.stamp_ns(), self.frame())

    def end(self) -> None:
        """Refuse bytes after the message, which mean that it is of another type."""
        left = len(self._cdr) - self._at
        if left > PADDING:
            raise self.bad(f"expected the end at byte {self._at}; found {left} more bytes")


def read_header(cdr: bytes) -> Header:
    """Read the std_msgs/Header with which a message begins; raises ``BadRosMessage``."""
    return CdrReader(cdr, "std_msgs/Header").header()
