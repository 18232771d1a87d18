"""Where a sensor with ``extrinsics = "transform"`` is mounted: as the transform that came last says, and not before."""

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from service_tools import GROUND, LEVEL, PRECISE, SECOND, T0, config

from roughmap_schemas import (
    Cloud,
    CloudReason,
    Config,
    IntegrationEvent,
    Odometry,
    PoseReason,
    Transform,
    decode_transform,
    encode_transform,
)
from roughmap_service.run.decoding import Content
from roughmap_service.run.inbox import Arrival
from roughmap_service.run.robot import Robot
from roughmap_service.run.run import Run, Taken
from roughmap_service.run.settings import Settings, new_map

BY_TRANSFORM = {"range_sigma": 0.01, "extrinsics": "transform"}
PLACE, TURN = (0.3, -0.2, 0.7), (0.0, 0.6, 0.0, 0.8)
OTHER = (1.0, 0.0, 0.5)


def begun(sensor: dict[str, Any] | None = None, **more: Any) -> Run:
    values = config(sensors={"lidar": sensor or BY_TRANSFORM}, input={"max_wait": 1.0}, **more)
    return Run(Settings(values), new_map(values), epoch=1)


def put(run: Run, content: Content, robot: str = "rover") -> Taken:
    """Apply a message that arrives at monotonic time 0."""
    return run.take(robot, content, (robot, "kind", str(run.input + 1)), T0, Arrival(0.0))


def pose(tenth: int) -> Odometry:
    return Odometry(T0 + tenth * SECOND // 10, "map", "base", (0.1 * tenth, 0.0, 1.0), LEVEL, PRECISE)


def cloud(tenth: int) -> Cloud:
    """A cloud between two poses."""
    return Cloud("lidar", T0 + tenth * SECOND // 10 + SECOND // 20, GROUND)


def mounting(place: Any = PLACE, turn: Any = LEVEL, stamp: int = 0, parent: str = "base_link") -> Transform:
    return decode_transform(encode_transform(stamp, parent, "lidar", place, turn), max_message=1 << 16)


def decide(run: Run, now: float = 0.0) -> list[IntegrationEvent]:
    events = []
    while (proposal := run.decide(now)) is not None:
        events.append(run.place(proposal)())
    return events


def scan(run: Run, tenth: int, robot: str = "rover") -> None:
    """A cloud with its poses."""
    for content in (pose(tenth), cloud(tenth), pose(tenth + 1)):
        put(run, content, robot)


def digest_of(*mountings: Transform | None, **configured: Any) -> str:
    """The map of two scans, with these transforms before each of them; the sensor's own settings, if any."""
    run = begun({"range_sigma": 0.01, **configured} if configured else None)
    for n, one in enumerate(mountings):
        if one is not None:
            put(run, one)
        scan(run, 2 * n)
        (event,) = decide(run)
        assert event.outcome == "integrated"
    return run.map.digest()


def test_a_transform_does_what_the_same_configured_mounting_does() -> None:
    assert digest_of(mounting(PLACE, TURN), None) == digest_of(None, None, translation=PLACE, rotation=TURN)
    assert digest_of(mounting(PLACE, TURN), None) != digest_of(None, None, translation=PLACE)


@given(
    st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: float(np.linalg.norm(q)) > 0.01),
)
@examples(20)
def test_no_bit_of_a_mounting_is_lost(place: tuple[float, ...], turn: tuple[float, ...]) -> None:
    """As it came, and after its state was written and read."""
    robot = Robot(begun().settings, "rover")
    came = mounting(place, turn)
    assert robot.mount(came) is not None
    again = Robot(robot.settings, "rover")
    again.load_state(json.loads(json.dumps(robot.to_state())))
    for one in (robot, again):
        known = one.mounting("lidar")
        assert known is not None
        assert (known.parent, known.translation, known.rotation) == ("base_link", came.translation, came.rotation)


@pytest.mark.parametrize("stamp", [0, T0 - 5 * SECOND, T0 + 5 * SECOND])
def test_the_newest_to_arrive_counts_whatever_its_stamp(stamp: int) -> None:
    first, second = mounting(PLACE, stamp=T0), mounting(OTHER, stamp=stamp)
    run = begun()
    put(run, first)
    scan(run, 0)
    decide(run)
    put(run, second)
    scan(run, 2)
    decide(run)
    both = begun({"range_sigma": 0.01, "translation": PLACE})
    scan(both, 0)
    decide(both)
    both.use(Settings(config(sensors={"lidar": {"range_sigma": 0.01, "translation": OTHER}})))
    scan(both, 2)
    decide(both)
    assert run.map.digest() == both.map.digest()


def test_what_is_decided_before_any_is_rejected_once_its_wait_is_over() -> None:
    run = begun()
    scan(run, 0)
    assert decide(run, 0.9) == []
    (event,) = decide(run, 1.0)
    assert (event.outcome, event.poses, event.accepted, run.clouds) == (CloudReason.NO_EXTRINSICS, [], 0, {})


def test_a_cloud_waits_for_the_mounting_as_for_its_poses() -> None:
    run = begun()
    scan(run, 0)
    assert decide(run, 0.9) == []
    put(run, mounting())
    assert [event.outcome for event in decide(run, 0.9)] == ["integrated"]
    known = begun({"range_sigma": 0.01, "translation": PLACE})
    scan(known, 0)
    decide(known)
    assert run.map.digest() == known.map.digest()


def test_a_cloud_whose_poses_go_while_it_waits_lacked_its_mounting() -> None:
    run = begun()
    scan(run, 0)
    for tenth in range(2, 200):
        put(run, pose(tenth))
    assert [event.outcome for event in decide(run, 0.1)] == [CloudReason.NO_EXTRINSICS]


def test_without_poses_that_is_what_is_missing() -> None:
    run = begun()
    put(run, cloud(0))
    assert [event.outcome for event in decide(run, 1.0)] == [CloudReason.NO_POSE]


@pytest.mark.parametrize(
    ("transform", "sensor"),
    [
        (mounting(parent="map"), BY_TRANSFORM),  # a sensor that is tracked itself
        (mounting(), {"range_sigma": 0.01}),
        (Transform(0, "base_link", "camera", PLACE, LEVEL), BY_TRANSFORM),
    ],
    ids=["from the map", "configured", "no sensor's frame"],
)
def test_other_transforms_mount_nothing(transform: Transform, sensor: dict[str, Any]) -> None:
    run = begun(sensor)
    taken = put(run, transform)
    assert taken.mounted is None
    assert taken.rejected == (None if transform.parent_frame_id == "map" else PoseReason.POSE_FRAME)
    assert run.robot("rover").to_state()["mountings"] == {}


def test_each_robot_has_its_own() -> None:
    """Their tables too: one is mounted by transforms, the other as its table says."""
    own = {"fixed": {"sensors": {"lidar": {"extrinsics": "configured", "translation": PLACE}}}}
    run = begun(BY_TRANSFORM, robots=own)
    assert put(run, mounting(OTHER), "fixed").rejected == PoseReason.POSE_FRAME
    put(run, mounting(PLACE), "one")
    for robot in ("fixed", "one", "two"):
        scan(run, 0, robot)
    outcomes = {event.robot: event.outcome for event in decide(run, 1.0)}
    assert outcomes == {"fixed": "integrated", "one": "integrated", "two": CloudReason.NO_EXTRINSICS}


def test_one_robot_may_be_the_only_one() -> None:
    run = begun({"range_sigma": 0.01, "translation": OTHER}, robots={"rover": {"sensors": {"lidar": BY_TRANSFORM}}})
    scan(run, 0)
    assert [event.outcome for event in decide(run, 1.0)] == [CloudReason.NO_EXTRINSICS]
    put(run, mounting())
    scan(run, 2)
    assert [event.outcome for event in decide(run)] == ["integrated"]


def test_a_mounting_beyond_all_maps_costs_the_points_alone() -> None:
    run = begun()
    put(run, mounting((1e308, -1e308, 1e308)))
    scan(run, 0)
    (event,) = decide(run)
    assert (event.outcome, sum(event.rejected.values())) == (CloudReason.EMPTY, len(GROUND))


def test_it_outlives_a_reset_and_a_clock_that_goes_back() -> None:
    run = begun()
    put(run, mounting())
    for tenth in range(300, 320):
        put(run, pose(tenth))
    run.reset()
    for tenth in range(20):
        put(run, pose(tenth))
    scan(run, 20)
    assert [event.outcome for event in decide(run)] == ["integrated"]


def test_a_state_without_mountings_is_that_of_an_earlier_version() -> None:
    robot = Robot(begun().settings, "rover")
    state = robot.to_state()
    del state["mountings"]
    robot.load_state(state)
    assert robot.mounting("lidar") is None


def test_an_integration_under_settings_that_its_log_does_not_have() -> None:
    """In a replay with other settings the cloud is placed as they say; here they don't say where the sensor is."""
    run = begun({"range_sigma": 0.01})
    scan(run, 0)
    (event,) = decide(run)
    other = begun()
    other.take("rover", pose(0), ("rover", "kind", "1"), T0)
    other.take("rover", cloud(0), ("rover", "kind", "2"), T0)
    other.take("rover", pose(1), ("rover", "kind", "3"), T0)
    found = other.follow(event)
    assert isinstance(found, IntegrationEvent)
    assert (found.outcome, found.accepted, other.map.tile_count) == (CloudReason.NO_EXTRINSICS, 0, 0)


def test_configurations_read_back() -> None:
    """Logs and stores hold all settings, also those that no file gave."""
    values = begun(robots={"r2": {"sensors": {"lidar": {"extrinsics": "configured", "translation": PLACE}}}}).settings
    assert Config.from_log(values.config.public_dict()) == values.config
