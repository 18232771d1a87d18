"""Where a robot's sensors are mounted, for those with ``extrinsics = "transform"``: the transform that came last."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

from roughmap_schemas import Transform
from roughmap_schemas.geometry import Quaternion, Vector
from roughmap_service.run.pose_algebra import angle_between, distance, quaternion, triple


@dataclass(frozen=True, slots=True)
class Mounting:
    """The pose of a sensor on its robot: ``translation`` in m, ``rotation`` x y z w, in ``parent``, the base frame."""

    parent: str
    translation: Vector
    rotation: Quaternion

    @classmethod
    def of(cls, parent: str, translation: Sequence[float], rotation: Sequence[float]) -> Self:
        """Return the mounting with these numbers."""
        return cls(parent, triple(translation), quaternion(rotation))

    def moved(self, other: "Mounting") -> tuple[float, float]:
        """Return how far the other one is from this one, in m, and how far it is turned, in rad."""
        return distance(self.translation, other.translation), angle_between(self.rotation, other.rotation)


class Mounted(NamedTuple):
    """A mounting that came for the sensor ``frame_id``, and the one before it; None: it is the first."""

    frame_id: str
    mounting: Mounting
    before: Mounting | None


@dataclass
class Mountings:
    """The mountings of one robot by the sensor's frame; as many as there are configured sensors, at most."""

    rows: dict[str, Mounting] = field(default_factory=dict)

    def take(self, transform: Transform) -> Mounted:
        """Take a transform to a sensor's frame: its mounting from now on, whatever its stamp."""
        frame_id = transform.child_frame_id
        before = self.rows.get(frame_id)
        self.rows[frame_id] = new = _mounting(transform)
        return Mounted(frame_id, new, before)

    def differs(self, transform: Transform) -> bool:
        """Return whether `take` would change anything."""
        return self.rows.get(transform.child_frame_id) != _mounting(transform)

    def to_state(self) -> dict[str, Any]:
        """Return everything as JSON values, exactly."""
        return {frame: [one.parent, one.translation, one.rotation] for frame, one in self.rows.items()}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `to_state` returned."""
        self.rows = {frame: Mounting.of(*one) for frame, one in state.items()}


def _mounting(transform: Transform) -> Mounting:
    return Mounting.of(transform.parent_frame_id, transform.translation, transform.rotation)
