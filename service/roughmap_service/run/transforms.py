"""A robot's transforms to the map frame, for odometry that is given in another one."""

from bisect import bisect_right, insort
from dataclasses import dataclass, field
from typing import Any

from roughmap_schemas import Transform
from roughmap_schemas.geometry import Quaternion, Vector
from roughmap_service.run.pose_algebra import angle_between, distance, quaternion, triple

MAX_TRANSFORMS = 1_000
"""Transforms kept of a robot. One per frame is needed; the others serve odometry that arrives late."""


@dataclass(frozen=True, slots=True)
class StampedTransform:
    """The pose of a child frame in the map frame, valid from a stamp on."""

    stamp_ns: int
    input: int
    translation: Vector
    rotation: Quaternion


@dataclass
class Transforms:
    """The transforms of one robot by child frame and stamp. One with stamp 0 holds at all times."""

    rows: dict[str, list[StampedTransform]] = field(default_factory=dict)

    def add(self, transform: Transform, number: int, jump_m: float, jump_rad: float, most: int) -> bool:
        """Add a transform; past ``most``, forget one. Return whether it moved by more than the given from the last."""
        new = StampedTransform(
            transform.stamp_ns, number, triple(transform.translation), quaternion(transform.rotation)
        )
        row = self.rows.setdefault(transform.child_frame_id, [])
        before = bisect_right(row, new.stamp_ns, key=_stamp)
        jumped = bool(before) and (
            distance(row[before - 1].translation, new.translation) > jump_m
            or angle_between(row[before - 1].rotation, new.rotation) > jump_rad
        )
        insort(row, new, key=_stamp)
        if sum(len(r) for r in self.rows.values()) > most:
            self._forget_one()
        return jumped

    def find(self, frame_id: str, stamp_ns: int, *, oldest: bool) -> StampedTransform | None:
        """Return a frame's newest transform that is not after a stamp; if there is none, the ``oldest`` if asked."""
        row = self.rows.get(frame_id, [])
        before = bisect_right(row, stamp_ns, key=_stamp)
        if not before:
            return row[0] if row and oldest else None
        return row[before - 1]

    def ahead(self, frame_id: str, stamp_ns: int) -> int:
        """Return by how many ns all transforms of a frame are later than a stamp; 0 if one is not, or there is none."""
        row = self.rows.get(frame_id, [])
        return max(row[0].stamp_ns - stamp_ns, 0) if row else 0

    def last(self, frame_id: str) -> StampedTransform | None:
        """Return a frame's transform that came last; None if there is none."""
        return max(self.rows.get(frame_id, []), key=lambda t: t.input, default=None)

    def keep_last(self) -> None:
        """Keep of each frame only what came last, for all times: the clock that the stamps are of is gone."""
        for frame_id, row in self.rows.items():
            last = max(row, key=lambda t: t.input)
            self.rows[frame_id] = [StampedTransform(0, last.input, last.translation, last.rotation)]

    def _forget_one(self) -> None:
        """Forget the first logged transform of the frame with most of them.

        So a static transform is not pushed out by a frequent one, nor those of a new clock by those of the clock
        before, whose stamps may be later.
        """
        child, row = max(self.rows.items(), key=lambda item: (len(item[1]), -min(t.input for t in item[1])))
        row.remove(min(row, key=lambda t: t.input))
        if not row:
            del self.rows[child]

    def to_state(self) -> dict[str, Any]:
        """Return everything as JSON values, exactly."""
        return {
            child: [[t.stamp_ns, t.input, t.translation, t.rotation] for t in row] for child, row in self.rows.items()
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `to_state` returned."""
        self.rows = {
            child: [StampedTransform(s, i, triple(t), quaternion(r)) for s, i, t, r in row]
            for child, row in state.items()
        }


def _stamp(item: StampedTransform) -> int:
    return item.stamp_ns
