"""All links of a robot's transforms, and the chain of them between two frames."""

from collections import deque
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

from roughmap_ros.tf.link import Link, Sample
from roughmap_ros.tf.rigid import IDENTITY, Rigid, compose, inverse, is_finite
from roughmap_schemas import Transform
from roughmap_schemas.geometry import MAX_STAMP_S, SECOND_NS, normalised
from roughmap_schemas.transform import MAX_FRAME

MAX_LINKS: Final = 500
"""Links kept: ten robots of fifty links on one topic."""

MAX_ALL_SAMPLES: Final = 100_000
"""Samples kept of all links together, some 60 MB."""

MAX_CHAINS: Final = 64
"""Chains that are remembered."""

SILENT_NS: Final = 30 * SECOND_NS
"""A parent that was silent for so long gives way to another one."""


class Step(NamedTuple):
    """A link of a chain; ``back``: from the child to the parent."""

    link: Link
    back: bool


Chain = tuple[Step, ...]


class Tree:
    """The links. They depend on nothing but the transforms and their order.

    Attributes:
        links: by parent and child, in the order in which they came.
        version: grows when links come or go, or a static one changes.
        era: grows when the clock is set back.
        refused: transforms that are none, or for which there is no room.
        full: the first link for which there was no room.
        replaced: children whose static parent changed, with the parents, newest last.
    """

    def __init__(self) -> None:
        self.links: dict[tuple[str, str], Link] = {}
        self.version = 0
        self.era = 0
        self.refused = 0
        self.full = ""
        self.replaced: dict[str, tuple[str, str]] = {}
        self._by_child: dict[str, list[Link]] = {}
        self._samples = 0
        self._chains: dict[tuple[str, str], Chain | None] = {}
        self._near: dict[str, list[tuple[Step, str]]] = {}

    def take(self, transforms: Iterable[Transform], *, static: bool, log_ns: int) -> None:
        """Add the transforms of a message that came at ``log_ns``. What is not usable is counted."""
        for transform in transforms:
            sample, parent, child = _sample(transform), transform.parent_frame_id, transform.child_frame_id
            if sample is None or not parent or not child or parent == child or max(len(parent), len(child)) > MAX_FRAME:
                self.refused += 1
                continue
            link = self._link(parent, child, static=static)
            if link is not None:
                link.heard_ns = log_ns
                self._put(link, sample, static=static, log_ns=log_ns)

    def parents(self, child: str) -> list[Link]:
        """Return the links whose child is this frame."""
        return self._by_child.get(child, [])

    def chain(self, target: str, source: str) -> Chain | None:
        """Return the links from a target frame to a source frame, the shortest way; None if they are not connected."""
        key = target, source
        if key not in self._chains:
            if len(self._chains) >= MAX_CHAINS:
                self._chains.clear()
            self._chains[key] = self._find(target, source)
        return self._chains[key]

    def find(self, target: str, source: str, stamp_ns: int) -> Rigid | None:
        """Return the pose of the source frame in the target frame at a stamp, as `along`; None if it is not known."""
        chain = self.chain(target, source)
        return None if chain is None else along(chain, stamp_ns)

    def connected(self, frame: str) -> set[str]:
        """Return all frames that are connected with a frame, and itself."""
        near = self._neighbours()
        seen, todo = {frame}, [frame]
        while todo:
            for step, other in near.get(todo.pop(), ()):
                if step.link.samples and other not in seen:
                    seen.add(other)
                    todo.append(other)
        return seen

    def _link(self, parent: str, child: str, *, static: bool) -> Link | None:
        link = self.links.get((parent, child))
        if link is not None:
            return link
        if len(self.links) >= MAX_LINKS:
            self.refused += 1
            self.full = self.full or f"{parent} -> {child}"
            return None
        if static:
            for other in [link for link in self.parents(child) if link.static]:
                self.replaced[child] = other.parent, parent
                self._remove(other)
        link = self.links[parent, child] = Link(parent, child, static=static)
        self._by_child.setdefault(child, []).append(link)
        self._changed()
        return link

    def _put(self, link: Link, sample: Sample, *, static: bool, log_ns: int) -> None:
        self._samples -= len(link.samples)
        if link.static != static:
            link.static, link.both = static, True
            link.samples.clear()
            link.late.clear()
            self._changed()
        if static:
            changed, back = link.fix(sample), False
        else:
            changed, back = not link.samples, link.add(sample, log_ns)
        if len(link.samples) + self._samples > MAX_ALL_SAMPLES:
            link.halve()
        self._samples += len(link.samples)
        if changed:
            self._changed()
        if back:
            self._begin_anew()
        if not static and len(self.parents(link.child)) > 1:
            for other in [o for o in self.parents(link.child) if not o.static and log_ns - o.heard_ns > SILENT_NS]:
                self._remove(other)

    def _begin_anew(self) -> None:
        for link in self.links.values():
            if not link.static:
                link.begin_anew()
        self._samples = sum(len(link.samples) for link in self.links.values())
        self.era += 1
        self._changed()

    def _remove(self, link: Link) -> None:
        del self.links[link.parent, link.child]
        self._by_child[link.child].remove(link)
        if not self._by_child[link.child]:
            del self._by_child[link.child]
        self._samples -= len(link.samples)
        self._changed()

    def _changed(self) -> None:
        self.version += 1
        self._chains.clear()
        self._near.clear()

    def _neighbours(self) -> dict[str, list[tuple[Step, str]]]:
        near = self._near
        for link in () if near else self.links.values():
            near.setdefault(link.parent, []).append((Step(link, back=False), link.child))
            near.setdefault(link.child, []).append((Step(link, back=True), link.parent))
        return near

    def _find(self, target: str, source: str) -> Chain | None:
        near = self._neighbours()
        if target != source and not (target in near and source in near):
            return None
        chains: dict[str, Chain] = {target: ()}
        todo = deque([target])
        while todo and source not in chains:
            frame = todo.popleft()
            for step, other in near.get(frame, ()):
                if other not in chains and step.link.samples:
                    chains[other] = (*chains[frame], step)
                    todo.append(other)
        return chains.get(source)


def along(chain: Sequence[Step], stamp_ns: int) -> Rigid | None:
    """Return the pose at a chain's end in the frame of its beginning.

    Links are interpolated at the stamp; before and after its samples, a link has its nearest one's pose. None if a link
    has no sample, or a sum overflows.
    """
    pose = IDENTITY
    for link, back in chain:
        one = link.at(stamp_ns)
        if one is None:
            return None
        pose = compose(pose, inverse(one) if back else one)
    return pose if is_finite(pose) else None


def _sample(transform: Transform) -> Sample | None:
    rotation = normalised(transform.rotation)
    if rotation is None or not 0 <= transform.stamp_ns < MAX_STAMP_S * SECOND_NS:
        return None
    pose = Rigid(transform.translation, rotation)
    return Sample(transform.stamp_ns, pose) if is_finite(pose) else None
