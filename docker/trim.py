"""Cut symbol tables and debug information off the end of shared libraries, like `strip`, which a base image may lack.

Usage: python trim.py FOLDER. Only the segments of an ELF file are loaded; sections behind the last segment are for
linkers and debuggers. Nothing is moved, so the loaded code stays as it was built.
"""

import struct
import sys
from pathlib import Path

ELF_64_LITTLE = b"\x7fELF\x02\x01"

saved = 0
for path in Path(sys.argv[1]).rglob("*.so*"):
    data = bytearray(path.read_bytes())
    if path.is_symlink() or not data.startswith(ELF_64_LITTLE):
        continue
    (segments,) = struct.unpack_from("<Q", data, 32)
    size, count = struct.unpack_from("<HH", data, 54)
    end = segments + size * count
    for header in range(segments, end, size):
        offset, length = struct.unpack_from("<Q", data, header + 8)[0], struct.unpack_from("<Q", data, header + 32)[0]
        end = max(end, offset + length)
    struct.pack_into("<Q", data, 40, 0)  # no section table
    struct.pack_into("<HHH", data, 58, 0, 0, 0)
    saved += len(data) - end
    path.write_bytes(data[:end])
print(f"trimmed by {saved >> 20} MiB")
