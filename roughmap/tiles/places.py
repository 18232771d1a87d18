"""Numbered places that hold one tile each: handed out, pinned by readers, and reused."""

import numpy as np

from roughmap.arrays import I4


class PlacePool:
    """Numbered places, each free, live (used by the map) or pinned (used by readers).

    A place becomes free when the map has released it and its last pin is gone. Only the writer calls these methods,
    under its lock. Subclasses decide what a place is and how the pool grows.
    """

    def __init__(self) -> None:
        self.pins = np.zeros(0, np.int32)
        self.live = np.zeros(0, np.bool_)
        self._free: list[int] = []

    @property
    def used(self) -> int:
        """Number of places that are not free."""
        return len(self.pins) - len(self._free)

    def _extend(self, number: int) -> None:
        """Add ``number`` free places, handed out in ascending order.

        All memory is allocated before anything changes, so that a MemoryError leaves the pool as it was.
        """
        first = len(self.pins)
        pins = np.append(self.pins, np.zeros(number, np.int32))
        live = np.append(self.live, np.zeros(number, np.bool_))
        free = [*self._free, *range(first + number - 1, first - 1, -1)]
        self.pins, self.live, self._free = pins, live, free

    def _grow(self) -> None:
        """Add at least one place; MemoryError if that is not possible."""
        raise NotImplementedError

    def _recycle(self, place: int) -> None:
        """Make a place free that neither the map nor a reader uses."""
        self._free.append(place)

    def allocate(self, number: int) -> I4:
        """Return ``number`` live places. After a MemoryError none is taken, but the pool may have grown."""
        while len(self._free) < number:
            self._grow()
        taken = self._free[len(self._free) - number :]
        del self._free[len(self._free) - number :]
        places = np.array(taken[::-1], np.int32)
        self.live[places] = True
        return places

    def release(self, places: I4) -> None:
        """Give back places that the map no longer uses. Pinned ones become free with their last unpin."""
        self.live[places] = False
        self._recycle_unused(places)

    def pin(self, places: I4) -> None:
        """Keep the content of these places, all different, unchanged until they are unpinned as often."""
        self.pins[places] += 1

    def unpin(self, places: I4) -> None:
        """Undo one :meth:`pin`."""
        self.pins[places] -= 1
        self._recycle_unused(places)

    def _recycle_unused(self, places: I4) -> None:
        for place in places[(self.pins[places] == 0) & ~self.live[places]].tolist():
            self._recycle(place)
