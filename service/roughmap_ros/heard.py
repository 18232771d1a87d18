"""When messages of a topic came."""

from dataclasses import dataclass

from roughmap_ros.tf.missing import STOPPED_INTERVALS, STOPPED_NS, stopped


@dataclass
class Heard:
    """One topic: how many messages came, and when the first and the last one did, in ns."""

    topic: str
    steady: bool = True
    """Whether its messages come at a rate."""
    needed: bool = True
    """Whether it is a problem that none ever came."""
    count: int = 0
    first_ns: int = 0
    last_ns: int = 0

    def note(self, log_ns: int) -> None:
        """A message came."""
        self.first_ns = self.first_ns if self.count else log_ns
        self.last_ns = max(self.last_ns, log_ns)
        self.count += 1

    def problem(self, now_ns: int) -> str:
        """Say that it never came, or stopped; "" if neither."""
        if not self.count:
            return f"{self.topic} never came" if self.needed else ""
        interval_ns = (self.last_ns - self.first_ns) // max(self.count - 1, 1)
        silent_ns = now_ns - self.last_ns
        if self.steady and silent_ns > max(STOPPED_NS, STOPPED_INTERVALS * interval_ns):
            return stopped(self.topic, silent_ns)
        return ""
