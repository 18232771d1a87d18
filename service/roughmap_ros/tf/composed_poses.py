"""The poses of a frame in another, composed link by link as the links' samples come."""

from collections.abc import Iterator
from typing import Final, NamedTuple

from roughmap_ros.tf.link import Link, Sample
from roughmap_ros.tf.rigid import Rigid
from roughmap_ros.tf.tree import Chain, Tree, along
from roughmap_schemas.geometry import SECOND_NS

WAIT_NS: Final = SECOND_NS // 5
"""How far the stamps go on before a slow link's newest pose is taken as holding: localisation by scans at 5 Hz comes in
time, and a cloud waits longer than this for its poses."""

FASTER: Final = 1.5
"""Only a link that is so much faster takes the lead: measured rates vary."""

AHEAD_NS: Final = SECOND_NS // 10
"""A link whose stamps are so much more ahead than those of a link nearer the base is stamped into the future."""

LEAST_RATE: Final = 5.0
"""Samples a second that a link needs to lead in place of one that is stamped into the future."""


class Stamped(NamedTuple):
    """A pose and its stamp."""

    stamp_ns: int
    pose: Rigid


class ComposedPoses:
    """The poses of ``source`` in ``target`` at the stamps of the chain's leading link, each once, in order.

    The fastest link leads. Localisation is often stamped into the future, as a promise: then the odometry leads. The
    other links are interpolated. If one of them has no sample at or after a stamp, the pose waits for it until the
    leader is 0.2 s past the stamp; then the link's newest pose holds.

    Attributes:
        early: poses that are not given, since a link had no sample at or before their stamp.
        last: the newest pose given.
    """

    def __init__(self, tree: Tree, target: str, source: str) -> None:
        self.tree = tree
        self.target = target
        self.source = source
        self.early = 0
        self.last: Stamped | None = None
        self._last_ns = -1
        self._era = tree.era
        self._fastest: Link | None = None

    def new(self, *, wait: bool = True) -> list[Stamped]:
        """Return the poses that can be given now; without ``wait``, what is known of a slow link holds at once."""
        if self._era != self.tree.era:
            self._era, self._last_ns = self.tree.era, -1
        chain = self.tree.chain(self.target, self.source)
        leader = None if chain is None else self._leader(chain)
        if chain is None or leader is None:
            return []
        others = [step.link for step in chain if not step.link.static and step.link is not leader]
        poses = []
        for sample in self._due(leader, others, wait=wait):
            self._last_ns = sample.stamp_ns
            if any(link.samples[0].stamp_ns > sample.stamp_ns for link in others):
                self.early += 1
                continue
            pose = along(chain, sample.stamp_ns)
            if pose is not None:
                poses.append(Stamped(sample.stamp_ns, pose))
        self.last = poses[-1] if poses else self.last
        return poses

    def fixed(self) -> Rigid | None:
        """Return the pose if all links are static, so that there are no stamps; None if not."""
        chain = self.tree.chain(self.target, self.source)
        return None if chain is None or _dynamic(chain) else along(chain, 0)

    def _due(self, leader: Link, others: list[Link], *, wait: bool) -> Iterator[Sample]:
        covered_ns = min((link.newest_ns for link in others), default=leader.newest_ns)
        for sample in leader.after(self._last_ns):
            if wait and covered_ns < sample.stamp_ns and leader.newest_ns - sample.stamp_ns < WAIT_NS:
                return
            yield sample

    def _leader(self, chain: Chain) -> Link | None:
        links = _dynamic(chain)
        if not links:
            return None
        fastest = max(reversed(links), key=lambda link: link.rate)
        if self._fastest not in links or fastest.rate > FASTER * self._fastest.rate:
            self._fastest = fastest
        at = links.index(self._fastest)
        honest = [
            link
            for link in links[at + 1 :]
            if self._fastest.lead_ns - link.lead_ns > AHEAD_NS and (link.rate >= LEAST_RATE or len(link.samples) == 1)
        ]
        return max(reversed(honest), key=lambda link: link.rate) if honest else self._fastest


def _dynamic(chain: Chain) -> list[Link]:
    return [step.link for step in chain if not step.link.static]
