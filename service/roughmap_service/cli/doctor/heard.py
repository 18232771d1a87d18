"""What `roughmap doctor` heard: the messages of each robot, as far as the judgements need them."""

from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from roughmap_schemas.geometry import Quaternion, Vector
from roughmap_schemas.kinds import INPUTS, Kind
from roughmap_service.cli.doctor.numbering import Numbers
from roughmap_service.cli.doctor.survey import Survey
from roughmap_service.cli.doctor.times import TimeSample
from roughmap_service.run.settings import NS

MAX_KEPT = 20_000
"""Messages kept of one robot's odometry, of its transforms, and of each of its sensors."""

MAX_SURVEYS = 40
"""Surveys kept of a sensor's clouds."""

MAX_SAMPLES = 5
"""Clouds of a sensor whose points' own times are kept."""


class Heard(NamedTuple):
    """When a message arrived on this machine's clock, and its stamp, both in ns."""

    arrival_ns: int
    stamp_ns: int


class HeardPose(NamedTuple):
    """An odometry; ``covariance`` as it was sent, 36 numbers in a good message."""

    arrival_ns: int
    stamp_ns: int
    frame_id: str
    position: Vector
    rotation: Quaternion
    covariance: tuple[float, ...]


class HeardTransform(NamedTuple):
    """A transform between two frames."""

    arrival_ns: int
    stamp_ns: int
    parent: str
    child: str
    translation: Vector
    rotation: Quaternion


class HeardCloud(NamedTuple):
    """A cloud and its number of points."""

    arrival_ns: int
    stamp_ns: int
    points: int


@dataclass
class HeardSensor:
    """The clouds in one frame; ``surveys`` and ``samples`` of some of them."""

    clouds: deque[HeardCloud] = field(default_factory=lambda: deque(maxlen=MAX_KEPT))
    surveys: deque[Survey] = field(default_factory=lambda: deque(maxlen=MAX_SURVEYS))
    samples: deque[TimeSample] = field(default_factory=lambda: deque(maxlen=MAX_SAMPLES))
    looked_at: bool = False
    """Whether its clouds are looked at more closely."""
    surveyed_ns: int = 0
    """Arrival of the last cloud that was surveyed."""


@dataclass
class Tally:
    """How many messages of a kind came, how many could not be read and why, and which numbers they had."""

    number: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    unnumbered: int = 0
    numbers: Numbers = field(default_factory=Numbers)


@dataclass
class Robot:
    """What one robot published."""

    tallies: dict[Kind, Tally] = field(default_factory=lambda: {kind: Tally() for kind in INPUTS})
    poses: deque[HeardPose] = field(default_factory=lambda: deque(maxlen=MAX_KEPT))
    transforms: deque[HeardTransform] = field(default_factory=lambda: deque(maxlen=MAX_KEPT))
    sensors: dict[str, HeardSensor] = field(default_factory=dict)


def times(messages: Iterable[HeardPose | HeardTransform | HeardCloud]) -> list[Heard]:
    """Return arrivals and stamps alone."""
    return [Heard(message.arrival_ns, message.stamp_ns) for message in messages]


def rate(messages: Sequence[Heard]) -> float:
    """Return messages per second, between the first and the last arrival."""
    if len(messages) < 2:
        return 0.0
    return (len(messages) - 1) * NS / max(messages[-1].arrival_ns - messages[0].arrival_ns, 1)
