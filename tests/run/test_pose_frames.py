"""Odometry in other frames: which transform holds, how it is composed; and a robot's state in the store."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from service_tools import LEVEL, SECOND, config

from roughmap_schemas import Odometry, PoseReason, Transform
from roughmap_service.run.odometry_clock import Verdict
from roughmap_service.run.poses import Pose, trajectory
from roughmap_service.run.robot import Robot
from roughmap_service.run.settings import Settings

TURNED = (0.0, 0.0, np.sin(0.5), np.cos(0.5))


def robot(**limits: int) -> Robot:
    """Transforms jump beyond 0.15 m and 0.03 rad."""
    return Robot(Settings(config(input={"pose_sigma": [0.05] * 3 + [0.01] * 3}), **limits), "rover")


def transform(
    stamp: int, x: float = 0.0, child: str = "odom", parent: str = "map", rotation: tuple = LEVEL
) -> Transform:
    return Transform(stamp, parent, child, (x, 0.0, 0.0), rotation)


def odometry(stamp: int, frame: str = "odom", x: float = 0.0) -> Odometry:
    return Odometry(stamp, frame, "base", (x, 0.0, 0.0), LEVEL, None)


def add(r: Robot, message: Odometry, number: int) -> PoseReason | None:
    """Take a message whose stamp is beyond doubt; return why it gives no pose."""
    (reason,) = r.take_odometry(message, number, arrival_ns=0).settled
    return reason


def chosen(stamps: list[tuple[int, int]], stamp: int) -> int:
    """The transform input that a pose of that stamp gets, after transforms of this (input, stamp)."""
    r = robot()
    for number, of in stamps:
        assert r.add_transform(transform(of), number) == (None, False)
    assert add(r, odometry(stamp), 1000) is None
    (pose,) = r.buffer.poses
    return pose.transform


def test_the_newest_not_after_the_stamp() -> None:
    row = [(1, 10), (2, 30), (3, 20)]
    assert [chosen(row, stamp) for stamp in (10, 19, 20, 29, 30, 99)] == [1, 1, 3, 3, 2, 2]


def test_the_oldest_known_if_all_are_later() -> None:
    """A static transform whose stamp is the start of its publisher says nothing about when it begins to hold."""
    assert chosen([(1, 30), (2, 20)], 9) == 2
    assert chosen([(1, 10**18)], 9) == 1


def test_one_without_a_stamp_holds_at_all_times() -> None:
    assert [chosen([(1, 0)], stamp) for stamp in (1, 10**18)] == [1, 1]
    assert [chosen([(1, 0), (2, 20)], stamp) for stamp in (19, 20)] == [1, 2]


def test_only_those_logged_before_the_pose_count() -> None:
    r = robot()
    r.add_transform(transform(10, 1.0), 1)
    assert add(r, odometry(20), 2) is None
    r.add_transform(transform(15, 2.0), 3)
    assert [(p.transform, p.position) for p in r.buffer.poses] == [(1, (1.0, 0.0, 0.0))], "chosen once: as it came"
    assert add(r, odometry(21), 4) is None
    assert r.buffer.poses[-1].transform == 3


def test_of_two_transforms_of_one_stamp_the_later_logged_holds() -> None:
    assert chosen([(1, 10), (2, 10)], 10) == 2


def test_frames_have_their_own_transforms() -> None:
    r = robot()
    r.add_transform(transform(10, child="wheels"), 1)
    assert add(r, odometry(20), 2) is PoseReason.POSE_FRAME
    assert add(r, odometry(21, "wheels"), 3) is None


def test_a_pose_without_a_frame_counts_for_the_clock() -> None:
    """Its stamp is as good as any, so a clock that goes back is seen even while nothing can be placed."""
    r = robot()
    for k in range(3):
        assert add(r, odometry(SECOND + k), k + 1) is PoseReason.POSE_FRAME
    taken = [r.take_odometry(odometry(k), 10 + k, 0) for k in range(1, 4)]
    assert [one.verdict for one in taken] == [Verdict.HOLD, Verdict.HOLD, Verdict.BACK]
    assert taken[-1].settled == [PoseReason.POSE_FRAME] * 3


def test_a_transform_whose_parent_is_not_the_map() -> None:
    r = robot()
    assert r.add_transform(transform(10, parent="earth"), 1) == (PoseReason.POSE_FRAME, False)
    assert r.transforms.rows == {}


@pytest.mark.parametrize(
    ("x", "rotation", "jumps"),
    [(0.1, LEVEL, 0), (0.2, LEVEL, 1), (0.0, (0.0, 0.0, 0.01, 1.0), 0), (0.0, (0.0, 0.0, 0.02, 1.0), 1)],
)
def test_a_jump_is_noticed(x: float, rotation: tuple, jumps: int) -> None:
    """Beyond 0.15 m or 0.03 rad; z = 0.01 is half of a turn by 0.02 rad. What was placed before stays."""
    r = robot()
    assert r.add_transform(transform(10), 1) == (None, False)
    add(r, odometry(12), 2)
    assert r.add_transform(transform(20, x, rotation=rotation), 3) == (None, bool(jumps))
    assert r.buffer.poses[0].position == (0.0, 0.0, 0.0)


def test_a_flood_of_transforms_drives_out_its_own_oldest() -> None:
    """Nor does a clock that was set back make the new transforms the ones that go."""
    r = robot(max_transforms=4)
    r.add_transform(transform(0, child="mast"), 1)
    for number, stamp in enumerate([100, 110, 120, 5, 6], 2):
        r.add_transform(transform(stamp), number)
    assert [t.input for t in r.transforms.rows["mast"]] == [1]
    assert [t.input for t in r.transforms.rows["odom"]] == [5, 6, 4]


def test_frames_without_end_are_bounded() -> None:
    r = robot(max_transforms=4)
    for number in range(1, 9):
        r.add_transform(transform(10, child=f"frame{number}"), number)
    assert list(r.transforms.rows) == ["frame5", "frame6", "frame7", "frame8"]


def test_after_a_clock_went_back_each_frame_keeps_its_last_transform() -> None:
    """For all times: the stamps of the clock before say nothing about the new one."""
    r = robot()
    for number, (stamp, child) in enumerate([(100, "odom"), (300, "odom"), (200, "odom"), (50, "mast")], 1):
        r.add_transform(transform(SECOND + stamp, 0.01 * number, child), number)
    for k in range(3):
        assert add(r, odometry(2 * SECOND + k), 10 + k) is None
    for k in range(1, 4):
        r.take_odometry(odometry(SECOND + 100 + k), 20 + k, 0)
    kept = {child: [(t.stamp_ns, t.input) for t in row] for child, row in r.transforms.rows.items()}
    assert kept == {"odom": [(0, 3)], "mast": [(0, 4)]}
    assert [p.transform for p in r.buffer.poses] == [3, 3, 3], "not by where the frame was then"
    assert add(r, odometry(SECOND + 104), 30) is None
    assert r.buffer.poses[-1].transform == 3


def test_wild_stamps_do_not_bring_the_last_transform_back() -> None:
    """What is late, or wild, is placed by the transform of its time once it counts."""
    r = robot()
    for number, stamp in ((1, 100), (2, 200)):
        r.add_transform(transform(SECOND + stamp, 0.01 * number), number)
    assert add(r, odometry(2 * SECOND), 10) is None
    for k in range(3):  # the first one was wild
        r.take_odometry(odometry(SECOND + 150 + k), 20 + k, 0)
    assert [p.transform for p in r.buffer.poses] == [1, 1, 1]


def test_numbers_that_overflow_are_no_pose() -> None:
    """Each finite, and their sums not: nothing that the map could be asked to place."""
    r = robot()
    r.add_transform(transform(0, 1.7e308), 1)
    assert add(r, odometry(10, x=1.7e308), 2) is PoseReason.POSE_FRAME
    assert add(r, odometry(11, x=-1.7e308), 3) is None


numbers = st.floats(-100, 100)
directions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(v * v for v in q) > 0.1)


@given(
    st.tuples(numbers, numbers, numbers), directions, st.tuples(numbers, numbers, numbers), directions, st.integers(0)
)
def test_composed_as_scipy_composes(t: tuple, q: tuple, position: tuple, turn: tuple, seed: int) -> None:
    outer, inner = Rotation.from_quat(q), Rotation.from_quat(turn)
    half = np.random.default_rng(seed % 2**32).normal(size=(6, 6))
    covariance = half @ half.T
    r = robot()
    r.add_transform(Transform(0, "map", "odom", t, tuple(outer.as_quat())), 1)
    assert add(r, Odometry(5, "odom", "base", position, tuple(inner.as_quat()), covariance), 2) is None
    (pose,) = r.buffer.poses
    # A few roundings of numbers up to 200 (positions), and of entries up to about 50 (covariances).
    np.testing.assert_allclose(pose.position, outer.apply(position) + t, atol=1e-12)
    expected = (outer * inner).as_quat()
    assert min(np.abs(expected - pose.rotation).max(), np.abs(expected + pose.rotation).max()) < 1e-14
    turned = np.kron(np.eye(2), outer.as_matrix())
    assert pose.covariance is not None
    np.testing.assert_allclose(pose.covariance, turned @ covariance @ turned.T, atol=1e-12)
    assert (pose.covariance == pose.covariance.T).all()


def test_an_unknown_covariance_is_the_configured_one() -> None:
    r = robot()
    r.add_transform(transform(0, rotation=TURNED), 1)
    add(r, odometry(5), 2)
    add(r, Odometry(6, "map", "base", (1.0, 0.0, 0.0), LEVEL, np.eye(6)), 3)
    assert r.buffer.poses[0].covariance is None
    way = trajectory(r.buffer.poses, np.eye(6) * 7)
    assert way.covariance[:, 0, 0].tolist() == [7.0, 1.0]


def test_a_covariance_is_settled_in_the_axes_of_the_message() -> None:
    """Its first axis is not measured; turned by a quarter that is the map's second one."""
    r = robot()
    quarter = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
    r.add_transform(transform(0, rotation=quarter), 1)
    taken = r.take_odometry(Odometry(5, "odom", "base", (0.0, 0.0, 0.0), LEVEL, np.diag([1e6, 1, 1, 1, 1, 1])), 2, 0)
    assert taken.unestimated
    (pose,) = r.buffer.poses
    assert pose.covariance is not None
    # A quarter turn's cosine is 0 but for rounding, 2.2e-16.
    np.testing.assert_allclose(np.diag(pose.covariance), [1, 0.0025, 1, 1, 1, 1], rtol=1e-14)


def _same(a: list[Pose], b: list[Pose]) -> None:
    """Assert that two rows of poses are equal to the bit."""
    for name in ("stamp_ns", "position", "rotation", "covariance"):
        way, again = (getattr(trajectory(row, np.eye(6)), name) for row in (a, b))
        assert way.tobytes() == again.tobytes()


@given(st.lists(st.tuples(st.integers(1, 3000), st.integers(0, 4), numbers, directions), max_size=30))
def test_the_state_goes_through_json_to_the_bit(messages: list[tuple]) -> None:
    r = robot()
    for number, (stamp, kind, x, turn) in enumerate(messages, 1):
        q = tuple(Rotation.from_quat(turn).as_quat())
        if kind == 0:
            r.add_transform(transform(stamp, x, rotation=q), number)
        else:
            covariance = np.eye(6) * abs(x) if kind == 1 else None
            frame = ("map", "odom")[kind % 2]
            r.take_odometry(Odometry(stamp, frame, "base", (x, x / 3, -0.0), q, covariance), number, stamp)
    other = robot()
    other.load_state(json.loads(json.dumps(r.to_state(), allow_nan=False)))
    assert json.dumps(other.to_state()) == json.dumps(r.to_state())
    assert [(p.stamp_ns, p.input, p.transform, p.leapt) for p in other.buffer.poses] == [
        (p.stamp_ns, p.input, p.transform, p.leapt) for p in r.buffer.poses
    ]
    if r.buffer.poses:
        _same(r.buffer.poses, other.buffer.poses)
