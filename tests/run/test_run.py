"""What an event does to the map: clouds of sensors and of the map's frame, what empties a cloud, what can't be."""

import numpy as np
import pytest
from service_tools import GROUND, LEVEL, PRECISE, SECOND, T0, config

from roughmap import RoughMap
from roughmap_schemas import (
    CheckpointEvent,
    Cloud,
    CloudReason,
    Config,
    IntegrationEvent,
    Odometry,
    ResetEvent,
    TimeForm,
    encode_cloud,
)
from roughmap_schemas.kinds import Kind
from roughmap_schemas.point_times import BAD_OFFSET, TimeField
from roughmap_service.run.decoding import decode
from roughmap_service.run.inbox import Proposal
from roughmap_service.run.placing import span
from roughmap_service.run.run import Run, RunError
from roughmap_service.run.settings import Settings, new_map

BAD = 2**32 - 1
"""No time of a point, in ns."""


def state(settings: Config | None = None) -> Run:
    """A run with poses at 0.0 and 0.1 s, inputs 1 and 2."""
    values = settings or config()
    s = Run(Settings(values), new_map(values), epoch=1)
    for number, t in enumerate((0, SECOND // 10), 1):
        pose = Odometry(T0 + t, "map", "base", (0.0, 0.0, 1.0), LEVEL, PRECISE)
        taken = s.take("rover", pose, ("rover", "odometry", str(t)), T0)
        assert taken.input == number
    return s


def integrate(s: Run, cloud: Cloud, **values: object) -> IntegrationEvent:
    """The cloud as input 3, placed with both poses unless ``values`` of the event say otherwise."""
    if cloud.time_fields:
        s.times.take(("rover", cloud.frame_id), TimeForm("t", "ns", "start"), s.settings)
    s.keep(3, "rover", cloud)
    given = {
        "epoch": 0, "input": 3, "robot": "rover", "poses": [(1, 0), (2, 0)], "outcome": "integrated", "accepted": 0,
        "rejected": {}, "sequence": 0, **values,
    }  # fmt: skip
    event = s.follow(IntegrationEvent.model_validate(given))
    assert isinstance(event, IntegrationEvent)
    assert 3 not in s.clouds
    return event


def scan(points: np.ndarray = GROUND, offsets: list[int] | None = None, frame: str = "lidar") -> Cloud:
    times = () if offsets is None else (TimeField("t", np.array(offsets, np.uint32)),)
    return Cloud(frame, T0 + SECOND // 20, points, time_fields=times)


def test_an_integration_says_what_it_did() -> None:
    s = state()
    points = np.vstack([GROUND, [[np.nan, 0, 0], [0, 0, 0]]])
    event = integrate(s, scan(points))
    assert (event.outcome, event.accepted, event.sequence, event.epoch) == ("integrated", len(GROUND), 1, 1)
    assert event.rejected == {"not_finite": 1, "no_return": 1}
    assert event.poses == [(1, 0), (2, 0)]


def test_points_whose_own_time_is_off_or_has_no_pose() -> None:
    """The scan is 50 ms before the last pose: a point 60 ms after its stamp has none."""
    event = integrate(state(), scan(offsets=[BAD, 0, 40_000_000, 60_000_000]))
    assert (event.accepted, event.rejected) == (2, {"time": 1, "no_pose": 1})


@pytest.mark.parametrize(
    "cloud",
    [scan(np.zeros((4, 3))), scan(np.empty((0, 3))), scan(offsets=[BAD] * 4), scan(np.full((2, 3), np.inf))],
    ids=["no returns", "no points", "no times", "not finite"],
)
def test_no_accepted_point_is_no_new_sequence(cloud: Cloud) -> None:
    s = state()
    event = integrate(s, cloud)
    assert (event.outcome, event.accepted, event.sequence) == (CloudReason.EMPTY, 0, 0)
    assert sum(event.rejected.values()) == len(cloud.points)
    assert s.map.tile_count == 0


@pytest.mark.parametrize(
    "outcome", [r for r in CloudReason if r not in (CloudReason.EMPTY, CloudReason.TOO_MANY_TILES)]
)
def test_what_was_rejected_before_changes_nothing(outcome: CloudReason) -> None:
    s = state()
    event = integrate(s, scan(), outcome=outcome, poses=[(7, 7)])
    assert (event.outcome, event.accepted, event.rejected, event.sequence) == (outcome, 0, {}, 0)


@pytest.mark.parametrize("limit", ["max_new_tiles", "max_tiles"])
def test_too_many_tiles_before_any_cell_is_written(limit: str) -> None:
    """Its points lie in two tiles; the limit of the map counts what is there already."""
    s = state(config(map={limit: 1}))
    wide = np.array([[1.0, 0.5, -0.5], [1.0, 7.0, -0.5]])
    event = integrate(s, scan(wide))
    assert (event.outcome, event.accepted, event.rejected) == (CloudReason.TOO_MANY_TILES, 0, {})
    assert (event.sequence, s.map.tile_count, s.map.digest()) == (0, 0, new_map(config()).digest())
    assert integrate(s, scan(wide[:1])).outcome == "integrated"
    assert integrate(s, scan(wide[1:])).outcome == ("integrated" if limit == "max_new_tiles" else "too_many_tiles")


def test_where_memory_is_full_and_in_its_replay_no_tile_is_new() -> None:
    """What was refused once is refused again, with all the memory there is; on known ground it is another outcome."""
    near, far = GROUND[:1], GROUND[:1] + np.array([10.0, 0.0, 0.0])
    live, again = state(), state()
    for s in (live, again):
        assert integrate(s, scan(near)).outcome == "integrated"
    proposal = Proposal(live.keep(3, "rover", scan(far)), "integrated", ((1, 0), (2, 0)))
    refused = live.place(proposal, no_new_tiles=True)()
    assert refused.outcome == CloudReason.TOO_MANY_TILES
    assert integrate(again, scan(far), outcome="too_many_tiles") == refused
    assert live.map.digest() == again.map.digest()
    proposal = Proposal(live.keep(3, "rover", scan(near)), "integrated", ((1, 0), (2, 0)))
    assert live.place(proposal, no_new_tiles=True)().outcome == "integrated"
    assert integrate(again, scan(near), outcome="too_many_tiles").outcome == "integrated", "no such event was logged"


def test_a_cloud_in_the_maps_frame() -> None:
    """No pose, no range, no ceiling, no exclusion; the covariance is `placed_sigma` squared; zeros are a place."""
    near = {"range_sigma": 0.01, "max_range": 0.1, "ceiling": -10.0, "exclude": [[-9, -9, -9, 9, 9, 9]]}
    values = config(input={"placed_sigma": 0.03}, sensors={"lidar": near})
    s = state(values)
    points = np.vstack([GROUND, [[0.0, 0.0, 0.0]]])
    event = integrate(s, scan(points, frame="map"), poses=[])
    assert (event.accepted, event.rejected) == (5, {})
    expected = new_map(values)
    expected.add(points, np.eye(3) * 0.03**2, T0 + SECOND // 20, common=0.03**2)
    assert s.map.digest() == expected.digest()


def test_times_in_the_maps_frame() -> None:
    """They are stamps of their own, and off where they are off."""
    s = state()
    event = integrate(s, scan(offsets=[0, BAD, SECOND, 0], frame="map"), poses=[])
    assert (event.accepted, event.rejected) == (3, {"time": 1})
    with s.map.freeze() as frozen:
        assert frozen.stamps(0, -1)[1] == T0 + SECOND // 20 + SECOND


def test_stamps_at_the_end_of_time() -> None:
    """Whole seconds of a point's time fit 32 bits, or it is off."""
    s = state()
    end = (1 << 32) * SECOND - 1
    event = integrate(
        s, Cloud("map", end, GROUND, time_fields=(TimeField("t", np.array([0, 1, 0, SECOND], np.uint32)),)), poses=[]
    )
    assert (event.accepted, event.rejected) == (2, {"time": 2})


def test_zero_rows_are_placed_by_the_messages_pose_in_the_maps_frame_alone() -> None:
    points, pose = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), ((5.0, 0.0, 2.0), LEVEL)
    for frame, first in (("map", [5.0, 0.0, 2.0]), ("lidar", [0.0, 0.0, 0.0])):
        cloud = decode(Kind.POINTS, encode_cloud(points, T0, frame, pose=pose), Settings(config()))
        assert isinstance(cloud, Cloud)
        assert cloud.points.tolist() == [first, [6.0, 0.0, 2.0]]


def test_a_sensor_that_is_no_longer_configured() -> None:
    """Its cloud waited over a restart with other settings: nobody can place it, and the service goes on."""
    event = integrate(state(), scan(frame="radar"))
    assert (event.outcome, event.accepted, event.rejected) == (CloudReason.EMPTY, 0, {"no_pose": 4})


def test_a_robots_own_sensor_goes_before_the_general_one() -> None:
    own = config(robots={"rover": {"sensors": {"lidar": {"max_range": 0.1}}}})
    assert integrate(state(own), scan()).rejected == {"range": 4}
    assert Settings(own).sensor("other", "lidar") != Settings(own).sensor("rover", "lidar")
    assert Settings(own).sensor("rover", "radar") is None


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"input": 4}, "input 4, which is not an undecided cloud"),
        ({"poses": [(1, 0), (9, 0)]}, r"\(9, 0\), which are not among the poses of rover"),
        ({"poses": [(1, 5), (2, 0)]}, r"\(1, 5\)"),
        ({"robot": "other"}, "input 3 of other, which is a cloud of rover"),
        ({"poses": [(2, 0), (1, 0)]}, "poses of rover for input 3 are not a trajectory"),
        ({"poses": []}, "poses of rover for input 3 are not a trajectory"),
    ],
)
def test_events_that_name_what_is_not_there(values: dict[str, object], said: str) -> None:
    s = state()
    with pytest.raises(RunError, match=said):
        integrate(s, scan(), **values)
    assert s.map.sequence == 0


def test_a_bug_is_not_reported_as_a_log_that_contradicts_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_args: object, **_options: object) -> None:
        raise ValueError("a bug")

    monkeypatch.setattr(RoughMap, "prepare_scan", broken)
    with pytest.raises(ValueError, match=r"^a bug$"):
        integrate(state(), scan())


def test_checkpoint_and_reset() -> None:
    s = state()
    integrate(s, scan())
    digest = s.map.digest()
    assert s.follow(CheckpointEvent(epoch=0, sequence=0, digest="0" * 32)) == CheckpointEvent(
        epoch=1, sequence=1, digest=digest
    )
    assert s.follow(ResetEvent(epoch=0, sequence=0)) == ResetEvent(epoch=2, sequence=2)
    assert s.map.digest() == RoughMap().digest()
    assert s.robot("rover").buffer.poses, "what is known of the robots stays"
    assert integrate(s, scan()).sequence == 3
    assert s.map.digest() == digest


def test_other_settings_hold_from_then_on() -> None:
    s = state()
    s.use(Settings(config(input={"pose_history": 0.05, "pose_sigma": [1, 1, 1, 1, 1, 1]})))
    for robot in (s.robots["rover"], s.robot("new")):
        assert robot.buffer.history_ns == SECOND // 20
        assert (robot.settings.jump_m, robot.settings.jump_rad) == (3.0, 3.0)


@pytest.mark.parametrize(
    ("offsets", "expected"),
    [
        (None, (0, 0)),
        ([], (0, 0)),
        ([5, 3, 9], (3, 9)),
        ([BAD_OFFSET, 3, 9], (3, 9)),
        ([0, SECOND], (0, SECOND)),
        ([0, SECOND + 1], (0, 0)),
        ([BAD_OFFSET, BAD_OFFSET], (0, 0)),
    ],
)
def test_the_span_of_a_cloud(offsets: list[int] | None, expected: tuple[int, int]) -> None:
    times = None if offsets is None else np.array(offsets, np.int64)
    points = np.zeros((0 if offsets is None else len(offsets), 3))
    assert span(Cloud("lidar", T0, points, times)) == (T0 + expected[0], T0 + expected[1])
