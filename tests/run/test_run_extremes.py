"""Whatever the decoders let pass is decided and applied: an exception there would end the service."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from service_tools import SECOND, config

from roughmap_schemas import (
    Cloud,
    Config,
    IntegrationEvent,
    MessageFault,
    SensorTimeEvent,
    encode_cloud,
    encode_event,
    encode_odometry,
    encode_transform,
)
from roughmap_schemas.kinds import Kind
from roughmap_service.run.decoding import Content, decode
from roughmap_service.run.duplicates import Duplicates
from roughmap_service.run.inbox import Arrival
from roughmap_service.run.placing import span
from roughmap_service.run.run import Run
from roughmap_service.run.settings import Settings, new_map

END = 2**32 * SECOND
"""The first stamp that there isn't."""

MODELS = ("point", "cuboid", "ellipsoid")
MAPS = {model: new_map(config(map={"error_model": model}, service={"threads": 1})) for model in MODELS}
"""Each with its threads, made once; tests empty them."""

BEGINNINGS = [(0, 1), (0, SECOND // 10), (END - 9, 1), (END - SECOND, SECOND // 10), (0, END // 9)]
"""The first stamp, and the length of a step."""

WILD = [0.0, -0.0, 5e-324, 1e-200, 2.0**31 / 10, -(2.0**31) / 10, 1e15, 1e154, -1e155, 1.7e308, -1.7e308]


class Robot:
    """Messages that can be read but no robot would send; most numbers are tame, so that the wild ones reach the map."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.first_ns, self.step_ns = BEGINNINGS[seed % len(BEGINNINGS)]
        self.wildness = (0.0, 0.03, 0.2)[seed // len(BEGINNINGS) % 3]

    def one_of(self, values: Sequence[Any]) -> Any:
        return values[self.random.integers(len(values))]

    def numbers(self, size: int, scale: float = 3.0) -> list[float]:
        tame = self.random.normal(0.0, scale, size).tolist()
        return [self.one_of(WILD) if self.random.random() < self.wildness else number for number in tame]

    def stamp(self) -> int:
        return int(min(self.first_ns + self.random.integers(10) * self.step_ns, END - 1))

    def message(self, kind: Kind) -> bytes:
        """One of that kind."""
        make = {Kind.TRANSFORM: self.transform, Kind.ODOMETRY: self.odometry, Kind.POINTS: self.cloud}
        return make[kind]()

    def transform(self) -> bytes:
        return encode_transform(self.stamp(), "map", "odom", self.numbers(3), self.numbers(4))

    def odometry(self) -> bytes:
        covariance = self.one_of([None, np.diag(np.abs(self.numbers(6, 0.01))), np.full((6, 6), self.one_of(WILD))])
        return encode_odometry(self.stamp(), self.one_of(["map", "odom"]), self.numbers(3), self.numbers(4), covariance)

    def cloud(self) -> bytes:
        points = np.array(self.numbers(15)).reshape(5, 3)
        if self.random.random() < 0.3:
            points[0, 0] = self.one_of([np.nan, np.inf, -np.inf])
        steps = np.minimum(self.random.integers(0, 4, 5) * self.step_ns, self.one_of([SECOND, SECOND + 1, 2**32 - 1]))
        pose = self.one_of([None, None, (self.numbers(3), self.numbers(4))])
        return encode_cloud(
            points, self.stamp(), self.one_of(["lidar", "lidar", "map"]), self.one_of([None, steps]), pose
        )


class Feed:
    """A run, fed with messages as the sequencer does it."""

    def __init__(self, values: Config, model: str = "cuboid") -> None:
        self.run = Run(Settings(values), MAPS[model])
        self.run.map.reset()

    def take(self, kind: Kind, payload: bytes) -> Content | None:
        """A message; None if the decoders refuse it."""
        try:
            content = decode(kind, payload, self.run.settings)
        except MessageFault:
            return None
        self.run.take("rover", content, Duplicates.identity("rover", kind, payload), 0, Arrival(0.0))
        return content

    def decide(self, now: float = 0.0) -> list[IntegrationEvent]:
        """All that is due; each event as its bytes can be written."""
        done = []
        for event in self.run.find_times(now):
            if isinstance(event, SensorTimeEvent):
                encode_event(self.run.read_times(event))
        while (proposal := self.run.decide(now)) is not None:
            done.append(self.run.place(proposal)())
            encode_event(done[-1])
        return done


@pytest.mark.parametrize("patient", [True, False])
@pytest.mark.parametrize("model", MODELS)
def test_nothing_that_can_be_read_can_fail(model: str, patient: bool) -> None:
    """Patient: with limits so wide that clouds are placed along the wildest of ways."""
    wide = {"max_speed": 1.7e308, "max_leap": 1.7e308, "max_pose_gap": 1.7e308, "pose_history": 1.7e308}
    values = config(map={"error_model": model}, input=wide if patient else {})
    outcomes: Counter[str] = Counter()
    for seed in range(150):
        feed, robot = Feed(values, model), Robot(seed)
        held = 0
        for kind in [Kind.TRANSFORM, *[Kind.ODOMETRY] * 5, *[Kind.POINTS, Kind.ODOMETRY] * 3]:
            held += isinstance(feed.take(kind, robot.message(kind)), Cloud)
        events = feed.decide() + feed.decide(now=1.0)
        assert len(events) == held, seed
        assert feed.run.clouds == {}, seed
        feed.run.map.digest()
        outcomes.update(str(event.outcome) for event in events)
    assert outcomes["integrated"] > 50, "most of this would test nothing else"


@pytest.mark.parametrize("sigma", [0.0, 1e-200, 1e200, 1.7e308])
def test_any_sigma_that_the_configuration_takes(sigma: float) -> None:
    """Its square may be no number; such a pose says nothing, and its points are rejected."""
    feed = Feed(config(input={"pose_sigma": [sigma] * 6, "placed_sigma": sigma}))
    for frame in ("lidar", "map"):
        feed.take(Kind.ODOMETRY, encode_odometry(SECOND, "map", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        feed.take(Kind.POINTS, encode_cloud(np.ones((3, 3)), SECOND, frame))
    events = feed.decide()
    assert [event.outcome for event in events] == (["integrated"] if sigma < 1.0 else ["empty"]) * 2
    assert sigma < 1.0 or all(sum(event.rejected.values()) == 3 for event in events)


def test_points_beyond_the_end_of_time_are_waited_for_by_nobody() -> None:
    """No pose can be as late as they would be; the map counts them as `time`."""
    told = {"time_field": "t", "time_unit": "ns", "time_origin": "start"}
    feed = Feed(config(sensors={"lidar": {"range_sigma": 0.01, **told}}))
    feed.take(Kind.ODOMETRY, encode_odometry(END - 10, "map", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    feed.take(Kind.ODOMETRY, encode_odometry(END - 1, "map", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    feed.take(Kind.POINTS, encode_cloud(np.ones((5, 3)), END - 5, "lidar", np.array([0, 4, 5, 6, SECOND])))
    (event,) = feed.decide()
    assert (event.outcome, event.accepted, event.rejected) == ("integrated", 2, {"time": 3})


def test_a_cloud_with_no_time_left_has_its_stamp() -> None:
    cloud = Cloud("lidar", END - 1, np.ones((2, 3)), np.array([1, SECOND]))
    assert span(cloud) == (END - 1, END - 1)


@pytest.mark.parametrize("offset", [-1.7e308, -1e300, -5e9, -1.7e9, 0.0, 1e-300, 2.5e9, 1e18, 1.7e308])
def test_any_offset_that_the_configuration_takes(offset: float) -> None:
    """Stamps that it moves out of all time are rejected; nothing fails."""
    feed = Feed(config(sensors={"lidar": {"range_sigma": 0.01, "time_offset": offset}}))
    at = 1_700_000_000 * SECOND
    for k in range(4):
        feed.take(Kind.ODOMETRY, encode_odometry(at + k * SECOND // 10, "map", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    for offsets in (None, np.linspace(0, 1e8, 3)):
        feed.take(Kind.POINTS, encode_cloud(np.ones((3, 3)), at + SECOND // 20, "lidar", offsets))
    events = feed.decide() + feed.decide(now=1.0)
    assert len(events) == 2
    assert all((event.outcome == "integrated") == (abs(offset) < 1.0) for event in events), events
