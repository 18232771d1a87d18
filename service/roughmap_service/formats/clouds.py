"""Read recorded clouds from any file format that has a reader."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from roughmap_service.formats.npz import read_npz
from roughmap_service.formats.recorded import CloudFileFault, PlacedPoints, RecordedScan
from roughmap_service.formats.text import read_text

READERS: Mapping[str, Callable[[Path], Iterator[RecordedScan | PlacedPoints]]] = {
    ".npz": read_npz,
    **dict.fromkeys((".asc", ".csv", ".txt", ".xyz"), read_text),
}
"""The reader for each suffix. A new format is a module with a reader, and a line here."""


def read_cloud(file: Path) -> Iterator[RecordedScan | PlacedPoints]:
    """Return the parts of a file in order. Raises CloudFileFault, or OSError if it can't be opened."""
    suffix = file.suffix.lower()
    if suffix not in READERS:
        allowed = ", ".join(sorted(READERS))
        raise CloudFileFault(f"{file}: unknown file format {suffix or '(no suffix)'!r} (allowed: {allowed})")
    return READERS[suffix](file)
