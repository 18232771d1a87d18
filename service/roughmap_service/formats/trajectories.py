"""Trajectories in text files with a pose in each line: TUM's form, `t x y z qx qy qz qw`, and KITTI's without stamps.

t is in seconds, and is read to the nanosecond; x, y and z are metres in the map frame, and the quaternion turns the
sensor's axes into the map's. Stamps must rise. Empty lines and those that begin with # are skipped.

A line in KITTI's form has the twelve numbers of a pose (3x4, row by row). Programs often write more digits there.
"""

from collections.abc import Callable, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roughmap_ros.tf.rigid import Rigid, between
from roughmap_schemas.geometry import MAX_STAMP_S, SECOND_NS, normalised, quaternion_of
from roughmap_service.formats.poses import BOTTOM, check_poses
from roughmap_service.formats.recorded import CloudFileFault, Floats

MAX_GAP_NS = 500_000_000
"""Between poses farther apart than this, nothing is known of the way."""

NEAR_NS = 1_000_000
"""A pose holds so long before and after its stamp: programs round the stamps that they write."""

UNIT_TOLERANCE = 1e-3
"""Most by which a quaternion's norm may differ from 1: those written with four decimals pass."""

MAX_LINE = 1 << 12
MAX_POSES = 5_000_000


class StampedPose(NamedTuple):
    """A pose of the sensor in the map: `position` (3,) in metres, `rotation` (4,) a unit quaternion x, y, z, w."""

    stamp_ns: int
    position: Floats
    rotation: Floats


class PoseFile(NamedTuple):
    """The poses of a file: `stamps` (K,) in nanoseconds, rising; `positions` (K, 3); `rotations` (K, 4)."""

    stamps: npt.NDArray[np.int64]
    positions: Floats
    rotations: Floats

    def at(self, stamp_ns: int) -> StampedPose | None:
        """Return the pose at a stamp: interpolated between neighbours at most 0.5 s apart, or of the very moment.

        None before the first pose, after the last one and in a gap.
        """
        after = int(np.searchsorted(self.stamps, stamp_ns))
        if after < len(self.stamps) and self.stamps[after] == stamp_ns:
            return StampedPose(stamp_ns, self.positions[after], self.rotations[after])
        around = [k for k in (after - 1, after) if 0 <= k < len(self.stamps)]
        if len(around) == 2 and self.stamps[after] - self.stamps[after - 1] <= MAX_GAP_NS:
            return self._between(after - 1, after, stamp_ns)
        near = min(around, key=lambda k: abs(int(self.stamps[k]) - stamp_ns), default=None)
        if near is None or abs(int(self.stamps[near]) - stamp_ns) > NEAR_NS:
            return None
        return StampedPose(stamp_ns, self.positions[near], self.rotations[near])

    def _between(self, a: int, b: int, stamp_ns: int) -> StampedPose:
        share = (stamp_ns - int(self.stamps[a])) / int(self.stamps[b] - self.stamps[a])
        pose = between(self._rigid(a), self._rigid(b), share)
        return StampedPose(stamp_ns, np.array(pose.translation), np.array(pose.rotation))

    def _rigid(self, k: int) -> Rigid:
        (x, y, z), (qx, qy, qz, qw) = self.positions[k].tolist(), self.rotations[k].tolist()
        return Rigid((x, y, z), (qx, qy, qz, qw))


def read_trajectory(path: Path) -> PoseFile:
    """Return the poses of a file; those without stamps are numbered by seconds: 0 s, 1 s and so on.

    Raises CloudFileFault, which names the line, and OSError.
    """
    stamps: list[int] = []
    rows: list[list[float]] = []
    with path.open("rb") as stream:
        number = 0
        while line := stream.readline(MAX_LINE):
            number += 1
            words = line.decode("utf-8", "replace").lstrip("\ufeff").split()
            if not words or words[0].startswith("#"):
                continue
            try:
                stamp, row = _row(words, len(stamps))
                if rows and len(row) != len(rows[0]):
                    raise ValueError(f"expected as many numbers as in the lines before, found {len(words)}")
                if stamps and stamp <= stamps[-1]:
                    raise ValueError(f"stamp {words[0]} is not after the one before; sort the lines, each stamp once")
                if len(stamps) == MAX_POSES:
                    raise ValueError(f"more than {MAX_POSES} poses; split the recording")
            except ValueError as error:
                raise CloudFileFault(f"{path}, line {number}: {error}") from error
            stamps.append(stamp)
            rows.append(row)
    if not stamps:
        raise CloudFileFault(f"{path}: expected lines 't x y z qx qy qz qw', found no pose")
    table, when = np.array(rows), np.array(stamps, np.int64)
    if table.shape[1] == 7:
        return PoseFile(when, table[:, :3], table[:, 3:])
    poses = table.reshape(-1, 3, 4)
    check_poses(path, np.concatenate([poses, np.broadcast_to(BOTTOM, (len(poses), 1, 4))], axis=1))
    return PoseFile(when, poses[:, :, 3], np.array([quaternion_of(pose) for pose in poses[:, :, :3].tolist()]))


def _row(words: Sequence[str], number: int) -> tuple[int, list[float]]:
    """Return the stamp in nanoseconds and the numbers of a pose, of which `number` came before. Raises ValueError."""
    expected = "expected 8 numbers, t x y z qx qy qz qw, or the 12 of a 3x4 matrix, found"
    if len(words) not in {8, 12}:
        raise ValueError(f"{expected} {len(words)}")
    try:
        values = [float(word) for word in words]
        seconds = Decimal(words[0])
    except (InvalidOperation, ValueError):
        raise ValueError(f"{expected} {' '.join(words)[:60]!r}") from None
    if len(values) == 12:
        return number * SECOND_NS, values
    if not seconds.is_finite() or not 0 <= seconds < MAX_STAMP_S:
        raise ValueError(f"expected t in seconds, 0 to 2^32, found {words[0][:30]}")
    x, y, z, w = values[4:]
    norm = float(np.sqrt(np.sum(np.square([x, y, z, w]))))
    if not np.isfinite(values).all() or abs(norm - 1) > UNIT_TOLERANCE:
        raise ValueError(f"expected finite numbers and a quaternion of norm 1, found norm {norm:.6g}")
    return round(seconds * SECOND_NS), [*values[1:4], *(normalised((x, y, z, w)) or ())]


def poses_of_clouds(
    folder: Path, stamps: Sequence[int] | None, count: int, file: Path, note: Callable[[str], None]
) -> list[StampedPose | None]:
    """Return the pose of each of `count` clouds by its stamp, None where the file has none.

    Without `stamps`, or if poses are just numbered or none is of their time, as many poses as clouds belong to them in
    turn. CloudFileFault if neither holds.
    """
    trajectory = read_trajectory(file)
    numbered = np.array_equal(trajectory.stamps, np.arange(count) * SECOND_NS)
    if stamps is not None and not numbered:
        poses = [trajectory.at(stamp) for stamp in stamps]
        if any(pose is not None for pose in poses):
            return poses
    if len(trajectory.stamps) == count:
        why = f"the poses in {file.name} have no stamps of these clouds"
        why = "the clouds have no stamps in their names" if stamps is None else why
        note(f"{folder}: {why}; each cloud has the pose of the same number")
        own = trajectory.stamps.tolist() if stamps is None else stamps
        return [StampedPose(*pose) for pose in zip(own, trajectory.positions, trajectory.rotations, strict=True)]
    first, last = (f"{stamp / SECOND_NS:.3f}" for stamp in (trajectory.stamps[0], trajectory.stamps[-1]))
    if stamps is None:
        raise CloudFileFault(
            f"{folder}: {count} clouds without stamps in their names, but {len(trajectory.stamps)} poses in {file}; "
            "name clouds by their stamps (1725981157.851716757.ply), or give as many poses"
        )
    raise CloudFileFault(
        f"{folder}: no pose in {file}, {first} to {last} s, is of the time of a cloud, {min(stamps) / SECOND_NS:.3f} "
        f"to {max(stamps) / SECOND_NS:.3f} s; give the trajectory of this recording"
    )
