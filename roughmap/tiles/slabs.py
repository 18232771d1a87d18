"""Anonymous memory for tiles: slabs of equal places, which kernels access by address."""

import contextlib
import mmap

import numpy as np
import numpy.typing as npt

from roughmap.arrays import Records

SLAB_PLACES = 64
"""Places of a slab."""


class Slabs:
    """Places of ``place_bytes``, a multiple of the page size, in private anonymous maps of zero pages.

    A slab never moves, and is never unmapped while a view of it is alive. A page takes memory once it is written.

    Attributes:
        address: (P,) uint64, the address of each place.
    """

    def __init__(self, place_bytes: int) -> None:
        self.place_bytes = place_bytes
        self._slabs: list[mmap.mmap] = []
        self.address = np.zeros(0, np.uint64)

    def grow(self, first: int, *, huge_pages: bool) -> None:
        """Add ``SLAB_PLACES`` places, numbered from ``first`` on; MemoryError, and no change, if that fails.

        Places that are there already with these numbers must not have been used yet.
        """
        size = self.place_bytes
        try:
            slab = mmap.mmap(-1, SLAB_PLACES * size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        except OSError as error:  # how mmap reports that memory is short
            raise MemoryError(f"no memory for {SLAB_PLACES} more tiles: {error.strerror}") from None
        with contextlib.suppress(OSError):  # not supported by kernels without huge pages
            slab.madvise(mmap.MADV_HUGEPAGE if huge_pages else mmap.MADV_NOHUGEPAGE)
        start = np.uint64(np.frombuffer(slab, np.uint8).ctypes.data)
        slabs = [*self._slabs[: first // SLAB_PLACES], slab]
        addresses = start + np.arange(SLAB_PLACES, dtype=np.uint64) * np.uint64(size)
        self.address = np.append(self.address[:first], addresses)
        self._slabs = slabs

    def give_back(self, place: int) -> None:
        """Return the pages of a place to the system; they read as zeros from then on."""
        slab, number = divmod(place, SLAB_PLACES)
        self._slabs[slab].madvise(mmap.MADV_DONTNEED, number * self.place_bytes, self.place_bytes)

    def view(self, place: int, dtype: npt.DTypeLike, number: int, offset: int = 0) -> Records:
        """Return ``number`` records of ``dtype`` that begin ``offset`` bytes after the start of a place."""
        slab, within = divmod(place, SLAB_PLACES)
        return np.frombuffer(self._slabs[slab], dtype, number, within * self.place_bytes + offset)
