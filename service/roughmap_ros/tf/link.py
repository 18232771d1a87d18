"""One link of the tree: the poses of a child frame in its parent, over time."""

from bisect import bisect_left, bisect_right
from typing import Final, NamedTuple

from roughmap_ros.tf.rigid import Rigid, between
from roughmap_schemas.geometry import SECOND_NS

MAX_SAMPLES: Final = 1_000
"""Samples kept of a link: 10 s at 100 Hz, and 1 s at 1,000 Hz, five times what poses wait for a slow link."""

MAX_AGE_NS: Final = 30 * SECOND_NS
"""How much older than the newest a kept sample may be."""

LATE_NS: Final = SECOND_NS
"""A sample that is later than this came from another clock, or from a recording that begins anew."""

ANEW: Final = 3
"""As many late samples in a row say that the clock was set back."""

RATE_SAMPLES: Final = 20
"""Samples over which a rate is measured."""


class Sample(NamedTuple):
    """A pose and its stamp."""

    stamp_ns: int
    pose: Rigid


class Link:
    """A child frame in its parent.

    Attributes:
        static: whether it holds at all times.
        both: whether it came as a static and as a dynamic one.
        samples: by stamp; of a static link the newest alone.
        late: samples in a row whose stamps are too old.
        late_count: all such samples since the clock was last set back.
        heard_ns: when the last message came.
        lead_ns: by how much the newest stamp was after its message's coming; negative as a rule.
    """

    def __init__(self, parent: str, child: str, *, static: bool) -> None:
        self.parent = parent
        self.child = child
        self.static = static
        self.both = False
        self.samples: list[Sample] = []
        self.late: list[Sample] = []
        self.late_count = 0
        self.heard_ns = 0
        self.lead_ns = 0

    def __str__(self) -> str:
        return f"{self.parent} -> {self.child}"

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest sample; -1 if there is none."""
        return self.samples[-1].stamp_ns if self.samples else -1

    @property
    def rate(self) -> float:
        """Samples a second by their stamps; 0 while it is not known."""
        last = self.samples[-RATE_SAMPLES:]
        if self.static or len(last) < 2:
            return 0.0
        return (len(last) - 1) * SECOND_NS / (last[-1].stamp_ns - last[0].stamp_ns)

    def fix(self, sample: Sample) -> bool:
        """Take the pose of a static link; return whether it changed."""
        changed = not self.samples or self.samples[0].pose != sample.pose
        self.samples = [sample]
        return changed

    def add(self, sample: Sample, log_ns: int) -> bool:
        """Take a sample of a dynamic link, the first of each stamp; return whether the clock was set back."""
        if sample.stamp_ns < self.newest_ns - LATE_NS:
            self.late.append(sample)
            self.late_count += 1
            return len(self.late) >= ANEW
        self.late.clear()
        newest = sample.stamp_ns > self.newest_ns
        if newest:
            self.samples.append(sample)
            self.lead_ns = sample.stamp_ns - log_ns
        else:
            at = bisect_left(self.samples, sample.stamp_ns, key=_stamp)
            if self.samples[at].stamp_ns == sample.stamp_ns:
                return False
            self.samples.insert(at, sample)
        self._trim(MAX_SAMPLES)
        return False

    def begin_anew(self) -> None:
        """Forget what is older than the late samples: they are of the new time."""
        by_stamp = {sample.stamp_ns: sample for sample in reversed(self.late)}
        self.samples = [by_stamp[stamp] for stamp in sorted(by_stamp)]
        self.late.clear()
        self.late_count = 0

    def halve(self) -> None:
        """Forget the older half of the samples."""
        self._trim(max(len(self.samples) // 2, 1))

    def _trim(self, most: int) -> None:
        oldest = self.newest_ns - MAX_AGE_NS
        drop = max(len(self.samples) - most, 0)
        while self.samples[drop].stamp_ns < oldest:
            drop += 1
        if drop:
            del self.samples[:drop]

    def after(self, stamp_ns: int) -> list[Sample]:
        """Return the samples after a stamp, oldest first."""
        return self.samples[bisect_right(self.samples, stamp_ns, key=_stamp) :]

    def at(self, stamp_ns: int) -> Rigid | None:
        """Return the pose at a stamp, between two samples interpolated, before and after all the nearest one's.

        None if there is no sample.
        """
        samples = self.samples
        if not samples:
            return None
        if self.static or stamp_ns >= samples[-1].stamp_ns:
            return samples[-1].pose
        at = bisect_right(samples, stamp_ns, key=_stamp)
        if at == 0:
            return samples[0].pose
        before, after = samples[at - 1], samples[at]
        if before.stamp_ns == stamp_ns:
            return before.pose
        share = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
        return between(before.pose, after.pose, share)


def _stamp(sample: Sample) -> int:
    return sample.stamp_ns
