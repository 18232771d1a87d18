"""Whatever the decoders let pass is decided and applied: an exception there would end the service."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from service_tools import SECOND, config

from roughmap_schemas import (
    Cloud,
    Config,
    IntegrationEvent,
    MessageFault,
    Odometry,
    encode_cloud,
    encode_event,
    encode_odometry,
    encode_transform,
)
from roughmap_service.apply import RunState, span
from roughmap_service.fold import Content, decode
from roughmap_service.inbox import Inbox, WaitingCloud
from roughmap_service.log_file import Kind
from roughmap_service.settings import Settings, new_map

END = 2**32 * SECOND
"""The first stamp that there isn't."""

MODELS = ("point", "cuboid", "ellipsoid")
MAPS = {model: new_map(config(map={"error_model": model}, service={"threads": 1})) for model in MODELS}
"""Each with its threads, made once; examples empty them."""

numbers = st.one_of(
    st.sampled_from([0.0, 1.0, -1.0, 5e-324, 2.0**31 / 10, -(2.0**31) / 10, 1e15, 1.7e308, -1.7e308]),
    st.floats(allow_nan=False, allow_infinity=False),
    st.floats(-3, 3),
)
coordinates = st.one_of(numbers, st.sampled_from([np.nan, np.inf, -np.inf]))
turns = st.tuples(numbers, numbers, numbers, numbers)
places = st.tuples(numbers, numbers, numbers)
frames = st.sampled_from(["map", "odom"])
stamps = st.one_of(
    st.sampled_from([0, 1, SECOND, END - SECOND, END - 2, END - 1]),
    st.integers(0, 2000),
    st.integers(END - 2000, END - 1),
)
covariances = st.one_of(
    st.none(),
    st.tuples(numbers.map(abs), numbers).map(lambda v: np.eye(6) * v[0] + np.full((6, 6), v[1] / 4)),
)
moves = st.tuples(st.just(Kind.TRANSFORM), st.tuples(stamps, frames, frames, places, turns))
poses = st.tuples(st.just(Kind.ODOMETRY), st.tuples(stamps, frames, places, turns, covariances))
points = st.lists(st.tuples(coordinates, coordinates, coordinates), min_size=0, max_size=5)
clouds = st.tuples(
    st.just(Kind.POINTS),
    st.tuples(
        points,
        stamps,
        st.sampled_from(["map", "lidar"]),
        st.one_of(st.none(), st.sampled_from([0, 1, SECOND, SECOND + 1, 2**32 - 1])),
        st.one_of(st.none(), st.tuples(places, turns)),
    ),
)


def encoded(kind: Kind, given: tuple[Any, ...]) -> bytes:
    """What a robot would send."""
    if kind is Kind.TRANSFORM:
        return encode_transform(*given)
    if kind is Kind.ODOMETRY:
        return encode_odometry(*given)
    rows, stamp_ns, frame, offset, pose = given
    times = None if offset is None else np.full(len(rows), offset)
    return encode_cloud(np.array(rows, np.float64).reshape(-1, 3), stamp_ns, frame, times, pose)


class Service:
    """What the sequencer does with a message, without its log."""

    def __init__(self, values: Config, model: str = "cuboid") -> None:
        self.state = RunState(Settings(values), MAPS[model])
        self.state.map.reset()
        self.inbox = Inbox(self.state.settings, self.state.poses)
        self.number = 0

    def take(self, kind: Kind, payload: bytes) -> Content | None:
        """A message; None if the decoders refuse it."""
        try:
            content = decode(kind, payload, self.state.settings)
        except MessageFault:
            return None
        self.number += 1
        if isinstance(content, Cloud):
            self.state.take_cloud(self.number, content)
            first, last = span(content)
            self.inbox.feed(WaitingCloud(self.number, "rover", content, first, last, 0.0, len(payload), ingested=False))
        elif isinstance(content, Odometry):
            if self.state.take_odometry(self.number, "rover", content)[1]:
                self.inbox.clock_reset("rover")
        else:
            self.state.take_transform(self.number, "rover", content)
        return content

    def decide(self, now: float = 0.0) -> list[IntegrationEvent]:
        """All that is due; each event as its bytes can be written."""
        done = []
        while (decision := self.inbox.tick(now)) is not None:
            event = self.state.apply(
                IntegrationEvent(
                    epoch=0, input=decision.cloud.input, robot="rover",
                    poses=[(pose.input, pose.transform) for pose in decision.poses], outcome=decision.outcome,
                    accepted=0, rejected={}, sequence=0,
                )
            )  # fmt: skip
            assert isinstance(event, IntegrationEvent)
            encode_event(event)
            done.append(event)
        return done


@given(st.sampled_from(MODELS), st.booleans(), st.lists(st.one_of(moves, poses, poses, clouds), max_size=14))
@settings(max_examples=300, deadline=None)
def test_nothing_that_can_be_read_can_fail(model: str, patient: bool, row: list[tuple[Kind, tuple[Any, ...]]]) -> None:
    """Patient: with limits so wide that clouds are placed along the wildest of ways."""
    wide = {"max_speed": 1.7e308, "max_turn": 1.7e308, "max_pose_gap": 1.7e308, "pose_history": 1.7e308}
    service = Service(config(map={"error_model": model}, input=wide if patient else {}), model)
    held = decided = 0
    for kind, given_ in row:
        held += isinstance(service.take(kind, encoded(kind, given_)), Cloud)
        decided += len(service.decide())
    decided += len(service.decide(now=1.0))
    assert decided == held
    assert service.state.clouds == {}
    service.state.map.digest()
    service.state.map.extent()


@pytest.mark.parametrize("sigma", [0.0, 1e-200, 1e200, 1.7e308])
def test_any_sigma_that_the_configuration_takes(sigma: float) -> None:
    """Its square may be no number; such a pose says nothing, and its points are rejected."""
    service = Service(config(input={"pose_sigma": [sigma] * 6, "placed_sigma": sigma}))
    for frame in ("lidar", "map"):
        service.take(Kind.ODOMETRY, encode_odometry(SECOND, "map", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        service.take(Kind.POINTS, encode_cloud(np.ones((3, 3)), SECOND, frame))
    events = service.decide()
    assert [event.outcome for event in events] == (["integrated"] if sigma < 1.0 else ["empty"]) * 2
    assert sigma < 1.0 or all(sum(event.rejected.values()) == 3 for event in events)


def test_points_beyond_the_end_of_time_are_waited_for_by_nobody() -> None:
    """No pose can be as late as they would be; the map counts them as `time`."""
    service = Service(config())
    service.take(Kind.ODOMETRY, encode_odometry(END - 10, "map", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    service.take(Kind.ODOMETRY, encode_odometry(END - 1, "map", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    times = np.array([0, 4, 5, 6, SECOND])
    cloud = service.take(Kind.POINTS, encode_cloud(np.ones((5, 3)), END - 5, "lidar", times))
    assert isinstance(cloud, Cloud)
    assert span(cloud) == (END - 5, END - 1)
    (event,) = service.decide()
    assert (event.outcome, event.accepted, event.rejected) == ("integrated", 2, {"time": 3})


def test_a_cloud_with_no_time_left_has_its_stamp() -> None:
    service = Service(config())
    cloud = service.take(Kind.POINTS, encode_cloud(np.ones((2, 3)), END - 1, "lidar", np.array([1, SECOND])))
    assert isinstance(cloud, Cloud)
    assert span(cloud) == (END - 1, END - 1)
