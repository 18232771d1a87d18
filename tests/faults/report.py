"""What was tried, how often, and what was found: told as it goes on stderr, and as a table at the end."""

import sys
import time
from dataclasses import dataclass, field

TELL_SECONDS = 2.0
"""How often progress is told."""


@dataclass
class Trial:
    """One kind of fault. ``found`` are violations; ``notes`` say what the service did that is worth knowing."""

    name: str
    tried: int = 0
    found: list[str] = field(default_factory=list)
    notes: dict[str, int] = field(default_factory=dict)
    begun: float = field(default_factory=time.monotonic)
    seconds: float = 0.0
    told: float = 0.0

    def once(self, what: str = "") -> None:
        """One more try was made."""
        self.tried += 1
        now = time.monotonic()
        self.seconds = now - self.begun
        if what:
            self.note(what)
        if now >= self.told + TELL_SECONDS:
            self.told = now
            print(f"{self.name}: {self.tried} tried, {len(self.found)} found", file=sys.stderr, flush=True)

    def note(self, what: str, number: int = 1) -> None:
        """Count something."""
        self.notes[what] = self.notes.get(what, 0) + number

    def expect(self, holds: bool, what: str) -> bool:
        """A violation unless it holds; gives back whether it does."""
        if not holds:
            self.found.append(what)
            print(f"{self.name}: FOUND {what}", file=sys.stderr, flush=True)
        return holds

    def check(self) -> None:
        """For tests: fail by what was found, and if nothing was tried."""
        assert not self.found, "\n".join(self.found)
        assert self.tried, f"{self.name}: nothing was tried"


def table(trials: list[Trial]) -> str:
    """The summary."""
    rows = [("what", "tried", "found", "seconds", "seen meanwhile")]
    for trial in trials:
        notes = ", ".join(f"{number} {what}" for what, number in trial.notes.items() if number)
        rows.append((trial.name, str(trial.tried), str(len(trial.found)), f"{trial.seconds:.0f}", notes))
    widths = [max(len(row[n]) for row in rows) for n in range(4)]
    return "\n".join("  ".join([*(row[n].ljust(widths[n]) for n in range(4)), row[4]]).rstrip() for row in rows)
