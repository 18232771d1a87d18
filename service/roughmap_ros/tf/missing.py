"""What is missing or wrong in the tree, in words."""

from difflib import get_close_matches
from typing import Final

from roughmap_ros.tf.link import Link
from roughmap_ros.tf.tree import Tree
from roughmap_schemas.geometry import SECOND_NS

STOPPED_NS: Final = SECOND_NS
STOPPED_INTERVALS: Final = 5
"""What comes at a rate has stopped after 1 s, or after five intervals if that is longer."""

APART_NS: Final = 5 * SECOND_NS
"""Stamps of two links that are farther apart are of two clocks."""

NAMED: Final = 4
"""Links that a sentence names."""

NUMBERS: Final = {2: "two", 3: "three"}


class Words:
    """Sentences on a tree; ``tf`` and ``tf_static`` are the names of the topics."""

    def __init__(self, tree: Tree, tf: str | None, tf_static: str | None) -> None:
        self.tree = tree
        self.topics = {False: tf, True: tf_static}

    def between(self, target: str, source: str, now_ns: int) -> list[str]:
        """Say why the pose of the source frame in the target frame is not known, or is not up to date any more."""
        chain = self.tree.chain(target, source)
        if chain is None:
            return [self._gap(target, source)]
        links = [step.link for step in chain if not step.link.static]
        words = [stopped(str(link), now_ns - link.heard_ns) for link in links if has_stopped(link, now_ns)]
        if not words and links:
            first, last = min(links, key=lambda x: x.newest_ns), max(links, key=lambda x: x.newest_ns)
            apart_ns = last.newest_ns - first.newest_ns
            if apart_ns > APART_NS and first.heard_ns > last.heard_ns - STOPPED_NS:
                words.append(f"{last} is stamped {apart_ns / SECOND_NS:.0f} s after {first}: set the computers' clocks")
        return words

    def tangled(self) -> list[str]:
        """Say which frames have several parents, and which links form a loop or are told in two ways."""
        words = []
        children = {link.child for link in self.tree.links.values()}
        for child in sorted(children):
            parents = [link.parent for link in self.tree.parents(child)]
            if len(parents) > 1:
                number = NUMBERS.get(len(parents), str(len(parents)))
                words.append(f"{number} parents of {child}: {', '.join(parents[:NAMED])}")
        for child, (old, new) in sorted(self.tree.replaced.items()):
            words.append(f"two parents of {child} on {self.topics[True]}: {old}, then {new}, which counts")
        loop = self._loop(sorted(children))
        if loop:
            words.append(f"a loop of transforms: {' -> '.join(loop)}")
        for link in self.tree.links.values():
            if link.both:
                words.append(f"{link} comes on {self.topics[False]} and on {self.topics[True]}: the last one counts")
            if link.late_count:
                words.append(
                    f"{link}: {link.late_count} transforms were more than 1 s older than others: is it sent twice?"
                )
        if self.tree.full:
            words.append(f"{self.tree.full} has no room: a robot's transforms may have {len(self.tree.links)} links")
        elif self.tree.refused:
            words.append(f"{self.tree.refused} transforms without two frames and a pose were left out")
        return words

    def _gap(self, target: str, source: str) -> str:
        for link in self.tree.links.values():
            if not link.samples and {link.parent, link.child} & {target, source}:
                return f"{link} has not come since the clock was set back"
        frames = {frame for link in self.tree.links.values() for frame in (link.parent, link.child)}
        if target in frames:
            top = self._top(source)
            what = f"{top} is not connected to {target}: "
        else:
            top = self._top(source) if source in frames else source
            what = f"{target} -> {top} never came; "
        unknown = next((frame for frame in (source, target) if frame not in frames), None)
        near = get_close_matches(unknown, sorted(frames), 1) if unknown else []
        meant = f"; or is {near[0]} meant by {unknown}" if near and near[0] != source and near[0] != target else ""
        return what + self._has(target, source) + meant

    def _has(self, target: str, source: str) -> str:
        links = list(self.tree.links.values())
        if not links:
            topics = [topic for topic in self.topics.values() if topic]
            return f"{' and '.join(topics)} {'have' if len(topics) > 1 else 'has'} no transforms" if topics else "no tf"
        near = self.tree.connected(target) | self.tree.connected(source)
        links.sort(key=lambda link: link.child not in near)  # stable: then in the order in which they came
        parts = []
        for static, topic in self.topics.items():
            here = [link for link in links if link.static == static]
            if here:
                more = f" and {len(here) - NAMED} more" if len(here) > NAMED else ""
                parts.append(f"{topic} has {', '.join(map(_link, here[:NAMED]))}{more}")
        return "; ".join(parts)

    def _top(self, frame: str) -> str:
        seen = {frame}
        while (parents := self.tree.parents(frame)) and parents[0].parent not in seen:
            frame = parents[0].parent
            seen.add(frame)
        return frame

    def _loop(self, children: list[str]) -> list[str]:
        done: set[str] = set()
        for child in children:
            way: list[str] = []
            frame = child
            while frame not in done and frame not in way and self.tree.parents(frame):
                way.append(frame)
                frame = self.tree.parents(frame)[0].parent
            if frame in way:
                loop = [frame, *reversed(way[way.index(frame) :])]
                return loop if len(loop) <= 2 * NAMED else [*loop[:NAMED], "...", loop[-1]]
            done.update(way)
        return []


def has_stopped(link: Link, now_ns: int) -> bool:
    """Return whether a link came at a rate, and comes no more."""
    limit_ns = STOPPED_NS if link.rate == 0.0 else max(STOPPED_NS, round(STOPPED_INTERVALS * SECOND_NS / link.rate))
    return not link.static and now_ns - link.heard_ns > limit_ns


def stopped(what: str, silent_ns: int) -> str:
    """Say that something stopped."""
    return f"{what} stopped {silent_ns / SECOND_NS:.1f} s ago"


def _link(link: Link) -> str:
    return f"{link} at {link.rate:.3g} Hz" if link.rate else str(link)
