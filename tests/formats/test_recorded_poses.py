"""Poses and stamps of recorded scans: what is no rigid transform or in another unit is refused in words."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from scipy.spatial.transform import Rotation

from roughmap_service.formats.clouds import read_cloud
from roughmap_service.formats.poses import check_poses
from roughmap_service.formats.recorded import CloudFileFault, RecordedScan

Floats = npt.NDArray[np.float64]
FILE = Path("scans.npz")


def pose(rotation: npt.ArrayLike = ((1, 0, 0), (0, 1, 0), (0, 0, 1)), place: npt.ArrayLike = (4, 5, 6)) -> Floats:
    made = np.eye(4)
    made[:3, :3] = rotation
    made[:3, 3] = place
    return made


def changed(row: int, column: int, value: float) -> Floats:
    made = pose()
    made[row, column] = value
    return made


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        (pose(np.diag([1, -1, 1])), "its rotation is mirrored (determinant -1)"),
        (pose(-np.eye(3)), "its rotation is mirrored (determinant -1)"),
        (pose(1.18 * np.eye(3)), "its rotation is scaled by 1.18"),
        (pose(np.diag([1, 1, 2])), "the axes (columns) of its rotation have the lengths 1 1 2"),
        (pose(np.diag([1, 1, 0])), "the axes (columns) of its rotation have the lengths 1 1 0"),
        (
            pose([[1, 0, 0.5], [0, 1, 0], [0, 0, 1]]),
            "its rotation is sheared: its axes x and z are 63.43 degrees apart",
        ),
        (pose(np.ones((3, 3))), "its rotation is sheared"),
        (pose(np.zeros((3, 3))), "its rotation is all zeros"),
        (pose().T, "it looks transposed: its translation stands in the bottom row"),
        (changed(3, 2, 5), "its bottom row is 0 0 5 1; expected 0 0 0 1"),
        (changed(3, 3, 0), "its bottom row is 0 0 0 0"),
        (changed(0, 3, np.nan), "nan in row 0, column 3"),
        (changed(1, 1, np.inf), "inf in row 1, column 1"),
        (np.zeros((4, 4)), "its bottom row is 0 0 0 0"),
        (pose(1e200 * np.eye(3)), "the axes (columns) of its rotation have the lengths inf inf inf"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, bad: Floats, said: str) -> None:
    file = tmp_path / "scans.npz"
    np.savez(file, points=np.ones((3, 3)), scan_start=np.arange(4), pose=np.array([pose(), pose(), bad]))
    with pytest.raises(CloudFileFault) as caught:
        list(read_cloud(file))
    message = str(caught.value)
    assert message.startswith(f"{file}: pose 2 (counted from 0): {said}")
    assert "\n" not in message


def test_how_many_are_bad_is_said() -> None:
    bad = pose(np.diag([1, -1, 1]))
    with pytest.raises(CloudFileFault, match=r"pose 1 .*2 of 3 poses are bad"):
        check_poses(FILE, np.array([pose(), bad, bad]))


rotations = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(x * x for x in q) > 1e-3).map(
    lambda q: Rotation.from_quat(q).as_matrix()
)  # fmt: skip


@given(turns=st.lists(rotations, min_size=1, max_size=5), place=st.tuples(*[st.floats(-1e7, 1e7)] * 3))
@examples(100)
def test_rotations_pass(turns: list[Floats], place: tuple[float, ...]) -> None:
    poses = np.array([pose(turn, place) for turn in turns])
    check_poses(FILE, poses)
    check_poses(FILE, poses.astype(np.float32).astype(np.float64))
    check_poses(FILE, np.array([pose(np.round(turn, 4), place) for turn in turns]))


@given(
    turns=st.lists(rotations, min_size=1, max_size=5), change=st.tuples(*[st.floats(-2, 2)] * 9), at=st.integers(0, 4)
)
@examples(300)
def test_what_is_far_from_a_rotation_does_not(turns: list[Floats], change: tuple[float, ...], at: int) -> None:
    """The distance is that of the nearest rotation, from the singular values."""
    at %= len(turns)
    matrix = turns[at] + np.reshape(change, (3, 3)) * min(1.0, abs(change[0]))
    poses = np.array([pose(turn) for turn in turns])
    poses[at, :3, :3] = matrix
    u, sizes, v = np.linalg.svd(matrix)
    sizes[2] *= np.linalg.det(u) * np.linalg.det(v)
    away = float(np.linalg.norm(sizes - 1))
    if away > 3e-3:
        with pytest.raises(CloudFileFault, match=f"pose {at}\\b"):
            check_poses(FILE, poses)
    elif away < 4e-4:
        check_poses(FILE, poses)


@given(turn=rotations, place=st.tuples(*[st.floats(-1e7, 1e7)] * 3).filter(lambda t: max(map(abs, t)) > 1e-3))
@examples(50)
def test_a_transposed_pose_is_seen(turn: Floats, place: tuple[float, ...]) -> None:
    with pytest.raises(CloudFileFault, match="looks transposed"):
        check_poses(FILE, pose(turn, place).T[None])


T0 = 1_700_000_000


@pytest.mark.parametrize(
    ("stamps", "said"),
    [
        ({"stamp_s": [T0 * 1e3, T0 * 1e3 + 100]}, "stamp_s looks like milliseconds (1700000000100); expected seconds"),
        ({"stamp_s": [T0 * 1e6, T0 * 1e6 + 1e5]}, "stamp_s looks like microseconds"),
        ({"stamp_s": [T0 * 10**9, T0 * 10**9 + 10**8]}, "stamp_s looks like nanoseconds"),
        ({"stamp_s": [1.0, 1e40]}, "expected seconds since the epoch, 0 to 2^32 s in stamp_s, found 1.0 .. 1e+40"),
        ({"stamp_ns": [T0, T0 + 1]}, "stamp_ns looks like seconds"),
        ({"stamp_ns": [T0 * 1000, T0 * 1000 + 100]}, "stamp_ns looks like milliseconds"),
        ({"stamp_ns": [T0 * 10**6, T0 * 10**6 + 100_000]}, "stamp_ns looks like microseconds"),
        ({"stamp_s": np.array([T0, T0 + 1], np.float32)}, "stamp_s is float32, whose steps are 128 s here"),
    ],
)
def test_stamps_in_other_units(tmp_path: Path, stamps: dict[str, object], said: str) -> None:
    file = tmp_path / "scans.npz"
    np.savez(file, points=np.ones((2, 3)), scan_start=np.arange(3), pose=np.array([pose(), pose()]), **stamps)  # type: ignore[arg-type]
    with pytest.raises(CloudFileFault) as caught:
        list(read_cloud(file))
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("stamps", "expected"),
    [
        ({"stamp_s": [0.0, 0.1]}, [0, 10**8]),
        ({"stamp_s": np.array([0.0, 0.5], np.float32)}, [0, 5 * 10**8]),
        ({"stamp_s": [T0, T0 + 1]}, [T0 * 10**9, (T0 + 1) * 10**9]),
        ({"stamp_ns": [10**9, 2 * 10**9]}, [10**9, 2 * 10**9]),
        ({"stamp_ns": [T0, T0]}, [T0, T0]),
        ({"stamp_ns": [T0 * 10**9, T0 * 10**9 + 10**8]}, [T0 * 10**9, T0 * 10**9 + 10**8]),
        ({"stamp_ns": [T0 * 10**9, T0 * 10**9 + 1]}, [T0 * 10**9, T0 * 10**9 + 1]),
    ],
)
def test_stamps_that_are_right(tmp_path: Path, stamps: dict[str, object], expected: list[int]) -> None:
    file = tmp_path / "scans.npz"
    np.savez(file, points=np.ones((2, 3)), scan_start=np.arange(3), pose=np.array([pose(), pose()]), **stamps)  # type: ignore[arg-type]
    assert [scan.stamp_ns for scan in read_cloud(file) if isinstance(scan, RecordedScan)] == expected
