"""Odometry in other frames: which transform holds, how it is composed; and the buffer's state in the store."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from service_tools import LEVEL

from roughmap_schemas import Odometry, PoseReason, Transform
from roughmap_service.run.poses import PoseBuffer, trajectory

TURNED = (0.0, 0.0, np.sin(0.5), np.cos(0.5))


def buffer() -> PoseBuffer:
    return PoseBuffer("map", 1000, jump_m=0.15, jump_rad=0.03)


def transform(
    stamp: int, x: float = 0.0, child: str = "odom", parent: str = "map", rotation: tuple = LEVEL
) -> Transform:
    return Transform(stamp, parent, child, (x, 0.0, 0.0), rotation)


def odometry(stamp: int, frame: str = "odom", x: float = 0.0) -> Odometry:
    return Odometry(stamp, frame, "base", (x, 0.0, 0.0), LEVEL, None)


def chosen(b: PoseBuffer, stamp: int) -> int:
    """The transform input that a new pose of that stamp gets."""
    assert b.add(odometry(stamp), 1000 + stamp)[0] is None
    return next(p.transform for p in b.poses if p.stamp_ns == stamp)


def test_the_newest_not_after_the_stamp() -> None:
    b = buffer()
    for number, stamp in [(1, 10), (2, 30), (3, 20)]:
        assert b.add_transform(transform(stamp), number) is None
    assert [chosen(b, stamp) for stamp in (10, 19, 20, 29, 30, 99)] == [1, 1, 3, 3, 2, 2]
    assert b.add(odometry(9), 50)[0] is PoseReason.POSE_FRAME


def test_only_those_logged_before_the_pose_count() -> None:
    b = buffer()
    b.add_transform(transform(10, 1.0), 1)
    assert chosen(b, 20) == 1
    b.add_transform(transform(15, 2.0), 3)
    assert b.poses[0].transform == 1, "chosen once, when the pose came"
    assert b.poses[0].position == (1.0, 0.0, 0.0)
    assert chosen(b, 21) == 3


def test_of_two_transforms_of_one_stamp_the_later_logged_holds() -> None:
    b = buffer()
    b.add_transform(transform(10, 1.0), 1)
    b.add_transform(transform(10, 2.0), 2)
    assert chosen(b, 10) == 2


def test_frames_have_their_own_transforms() -> None:
    b = buffer()
    b.add_transform(transform(10, child="wheels"), 1)
    assert b.add(odometry(20), 2)[0] is PoseReason.POSE_FRAME
    assert b.add(odometry(20, "wheels"), 3)[0] is None


def test_a_transform_whose_parent_is_not_the_map() -> None:
    b = buffer()
    assert b.add_transform(transform(10, parent="earth"), 1) is PoseReason.POSE_FRAME
    assert b.transforms == {}


@pytest.mark.parametrize(
    ("x", "rotation", "jumps"),
    [(0.1, LEVEL, 0), (0.2, LEVEL, 1), (0.0, (0.0, 0.0, 0.01, 1.0), 0), (0.0, (0.0, 0.0, 0.02, 1.0), 1)],
)
def test_a_jump_is_counted(x: float, rotation: tuple, jumps: int) -> None:
    """Beyond 0.15 m or 0.03 rad; z = 0.01 is half of a turn by 0.02 rad. What was placed before stays."""
    b = buffer()
    b.add_transform(transform(10), 1)
    b.add(odometry(12), 2)
    b.add_transform(transform(20, x, rotation=rotation), 3)
    assert b.jumps == jumps
    assert b.poses[0].position == (0.0, 0.0, 0.0)


def test_a_flood_of_transforms_drives_out_its_own_oldest() -> None:
    """Nor does a clock that was set back make the new transforms the ones that go."""
    b = buffer()
    b.max_transforms = 4
    b.add_transform(transform(0, child="mast"), 1)
    for number, stamp in enumerate([100, 110, 120, 5, 6], 2):
        b.add_transform(transform(stamp), number)
    assert [t.input for t in b.transforms["mast"]] == [1]
    assert [t.input for t in b.transforms["odom"]] == [5, 6, 4]


def test_frames_without_end_are_bounded() -> None:
    b = buffer()
    b.max_transforms = 4
    for number in range(1, 9):
        b.add_transform(transform(10, child=f"frame{number}"), number)
    assert list(b.transforms) == ["frame5", "frame6", "frame7", "frame8"]


def test_numbers_that_overflow_are_no_pose() -> None:
    """Each finite, and their sums not: nothing that the map could be asked to place."""
    b = buffer()
    b.add_transform(transform(0, 1.7e308), 1)
    assert b.add(odometry(10, x=1.7e308), 2)[0] is PoseReason.POSE_FRAME
    b.add_transform(transform(5, rotation=TURNED), 3)
    far = np.full((6, 6), 1.7e308)
    assert b.add(Odometry(10, "odom", "base", (0.0, 0.0, 0.0), LEVEL, far), 4)[0] is PoseReason.BAD_COVARIANCE


numbers = st.floats(-100, 100)
directions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(v * v for v in q) > 0.1)


@given(
    st.tuples(numbers, numbers, numbers), directions, st.tuples(numbers, numbers, numbers), directions, st.integers(0)
)
def test_composed_as_scipy_composes(t: tuple, q: tuple, position: tuple, turn: tuple, seed: int) -> None:
    outer, inner = Rotation.from_quat(q), Rotation.from_quat(turn)
    half = np.random.default_rng(seed % 2**32).normal(size=(6, 6))
    covariance = half @ half.T
    b = buffer()
    b.add_transform(Transform(0, "map", "odom", t, tuple(outer.as_quat())), 1)
    b.add(Odometry(5, "odom", "base", position, tuple(inner.as_quat()), covariance), 2)
    (pose,) = b.poses
    # A few roundings of numbers up to 200 (positions), and of entries up to about 50 (covariances).
    np.testing.assert_allclose(pose.position, outer.apply(position) + t, atol=1e-12)
    expected = (outer * inner).as_quat()
    assert min(np.abs(expected - pose.rotation).max(), np.abs(expected + pose.rotation).max()) < 1e-14
    turned = np.kron(np.eye(2), outer.as_matrix())
    assert pose.covariance is not None
    np.testing.assert_allclose(pose.covariance, turned @ covariance @ turned.T, atol=1e-12)
    assert (pose.covariance == pose.covariance.T).all()


def test_an_unknown_covariance_is_the_configured_one() -> None:
    b = buffer()
    b.add_transform(transform(0, rotation=TURNED), 1)
    b.add(odometry(5), 2)
    b.add(Odometry(6, "map", "base", (1.0, 0.0, 0.0), LEVEL, np.eye(6)), 3)
    assert b.poses[0].covariance is None
    way = trajectory(b.poses, np.eye(6) * 7)
    assert way.covariance[:, 0, 0].tolist() == [7.0, 1.0]


@given(st.lists(st.tuples(st.integers(0, 3000), st.integers(0, 4), numbers, directions), max_size=30))
def test_the_state_goes_through_json_to_the_bit(messages: list[tuple]) -> None:
    b = buffer()
    for number, (stamp, kind, x, turn) in enumerate(messages, 1):
        q = tuple(Rotation.from_quat(turn).as_quat())
        if kind == 0:
            b.add_transform(transform(stamp, x, rotation=q), number)
        else:
            covariance = np.eye(6) * abs(x) if kind == 1 else None
            b.add(Odometry(stamp, ("map", "odom")[kind % 2], "base", (x, x / 3, -0.0), q, covariance), number)
    other = buffer()
    other.load_state(json.loads(json.dumps(b.to_state(), allow_nan=False)))
    assert json.dumps(other.to_state()) == json.dumps(b.to_state())
    assert [(p.stamp_ns, p.input, p.transform) for p in other.poses] == [
        (p.stamp_ns, p.input, p.transform) for p in b.poses
    ]
    if not b.poses:
        return
    way, again = (trajectory(x.poses, np.eye(6)) for x in (b, other))
    for name in ("stamp_ns", "position", "rotation", "covariance"):
        assert getattr(way, name).tobytes() == getattr(again, name).tobytes()
