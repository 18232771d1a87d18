"""How busy the machine was."""

import os
import resource
import time
from pathlib import Path


class Load:
    """What others took of the machine's cores since this was made."""

    def __init__(self) -> None:
        self._begun = time.monotonic()
        self._before = _seconds()

    def line(self) -> str:
        """In one line."""
        seconds, cores = time.monotonic() - self._begun, os.cpu_count() or 1
        given, stolen, own = (now - before for now, before in zip(_seconds(), self._before, strict=True))
        others, kept = (100 * part / seconds / cores for part in (max(given - own, 0.0), stolen))
        return (
            f"Of the machine's {cores} cores other programs took {others:.0f} %, and its host kept back {kept:.0f} %, "
            f"on average over the {seconds / 60:.1f} min of this measurement."
        )


def _seconds() -> tuple[float, float, float]:
    """CPU time in seconds: all that the machine gave, what its host kept back, and what was ours."""
    user, nice, system, _, _, irq, soft, steal = map(int, Path("/proc/stat").read_text().split()[1:9])
    ticks = os.sysconf("SC_CLK_TCK")
    own = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    given = (user + nice + system + irq + soft) / ticks
    return given, steal / ticks, sum(used.ru_utime + used.ru_stime for used in own)
