"""The chunks of a LAZ file: sizes that lazrs takes memory for, checked before it does.

The 8 bytes before the first chunk say where the table of chunks stands; if they are -1, the last 8 bytes of the file
do. The table begins with a version and the number of chunks. A chunk begins with a point that is not packed. From point
format 6 on, a count and the bytes of each of its layers follow, then the layers.
"""

import struct
from pathlib import Path
from typing import BinaryIO

from roughmap_service.formats.blocks import size_of
from roughmap_service.formats.las_header import LasHeader
from roughmap_service.formats.recorded import CloudFileFault

LAYERED = 3
"""The compressor that packs a chunk in layers."""

LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Layers of each type of item; extra bytes (14) have one each."""

ITEMS = 32
"""Where the number of items stands in LASzip's record."""


def check_chunks(file: Path, stream: BinaryIO, header: LasHeader) -> None:
    """Raise CloudFileFault if the chunks don't fit into the file. The stream's place is moved."""
    size = size_of(stream)
    stream.seek(header.begin)
    place = _number(stream, "<q")
    if place == -1:
        stream.seek(size - 8)
        place = _number(stream, "<q")
    if not header.begin + 8 <= place <= size - 8:
        raise CloudFileFault(f"{file}: its table of chunks is missing; the file is cut off: copy it again")
    stream.seek(place + 4)
    chunks = _number(stream, "<I")
    begin = header.begin + 8
    if chunks > (place - begin) // header.record_bytes:
        raise CloudFileFault(f"{file}: expected {chunks} chunks before byte {place}, more than fit; it is damaged")
    layers = _layers(header.laszip)
    if not layers:
        return
    for chunk in range(chunks):
        stream.seek(begin + header.record_bytes + 4)
        data = stream.read(4 * layers)
        begin = stream.tell() + sum(struct.unpack(f"<{len(data) // 4}I", data[: len(data) // 4 * 4]))
        if len(data) < 4 * layers or begin > place:
            raise CloudFileFault(f"{file}: chunk {chunk} of {chunks} does not end before byte {place}; it is damaged")


def _number(stream: BinaryIO, form: str) -> int:
    return int(struct.unpack(form, stream.read(struct.calcsize(form)).ljust(struct.calcsize(form), b"\0"))[0])


def _layers(laszip: bytes) -> int:
    """Return the number of layers of a chunk, 0 if it has none."""
    if len(laszip) < ITEMS + 2 or struct.unpack_from("<H", laszip)[0] != LAYERED:
        return 0
    count = min(_item_count(laszip), (len(laszip) - ITEMS - 2) // 6)
    items = struct.iter_unpack("<3H", laszip[ITEMS + 2 : ITEMS + 2 + 6 * count])
    return sum(size if kind == 14 else LAYERS.get(kind, 0) for kind, size, _ in items)


def _item_count(laszip: bytes) -> int:
    return int(struct.unpack_from("<H", laszip, ITEMS)[0])
