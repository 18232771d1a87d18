"""Recorded poses: what is no rigid transform, in words.

A pose is rigid if its bottom row is 0 0 0 1 and the three axes of its rotation (the columns of R) have length 1, stand
at right angles and are right-handed: R^T R = 1, det R = 1.
"""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from roughmap_service.formats.recorded import CloudFileFault, Floats

TOLERANCE = 1e-3
"""Most by which an element of R^T R may differ from the identity: poses written with four decimals pass."""

ROW_TOLERANCE = 1e-6
"""Most by which an element of the bottom row may differ from 0 0 0 1."""

BOTTOM = np.array([0.0, 0.0, 0.0, 1.0])


def check_poses(file: Path, poses: Floats) -> None:
    """Raise CloudFileFault for the first of the `poses` (K, 4, 4) that is no rigid transform."""
    bad = np.flatnonzero(~_rigid(poses))
    if bad.size:
        k = int(bad[0])
        others = f" ({bad.size} of {len(poses)} poses are bad)" if bad.size > 1 else ""
        raise CloudFileFault(f"{file}: pose {k}{' (counted from 0)' if k else ''}: {fault(poses[k])}{others}")


def _rigid(poses: Floats) -> npt.NDArray[np.bool_]:
    with np.errstate(all="ignore"):  # what is not finite, or overflows, compares as not rigid
        rotation = poses[:, :3, :3]
        gram = rotation.transpose(0, 2, 1) @ rotation
        unit = (np.abs(gram - np.eye(3)) <= TOLERANCE).all(axis=(1, 2))
        bottom = (np.abs(poses[:, 3] - BOTTOM) <= ROW_TOLERANCE).all(axis=1)
        right: npt.NDArray[np.bool_] = (
            unit & bottom & (_determinant(rotation) > 0) & np.isfinite(poses).all(axis=(1, 2))
        )
    return right


def _determinant(rotation: Floats) -> Floats:
    x, y, z = rotation[..., 0], rotation[..., 1], rotation[..., 2]
    return np.asarray(np.sum(np.cross(x, y) * z, axis=-1))


def fault(pose: Floats) -> str:
    """Return what is wrong with a pose (4, 4) that is not rigid."""
    if not np.isfinite(pose).all():
        row, column = np.argwhere(~np.isfinite(pose))[0]
        return f"{pose[row, column]} in row {row}, column {column}; leave that scan out"
    with np.errstate(all="ignore"):
        right_column = (np.abs(pose[:, 3] - BOTTOM) <= ROW_TOLERANCE).all()
        if (np.abs(pose[3] - BOTTOM) <= ROW_TOLERANCE).all():
            return _rotation_fault(pose[:3, :3])
        if right_column:
            return "it looks transposed: its translation stands in the bottom row; expected in the last column"
        return f"its bottom row is {_row(pose[3])}; expected 0 0 0 1"


def _rotation_fault(rotation: Floats) -> str:
    lengths = np.sqrt(np.sum(rotation * rotation, axis=0))
    uneven = f"the axes (columns) of its rotation have the lengths {_row(lengths)}; expected 1"
    if not lengths.any():
        return "its rotation is all zeros"
    if not lengths.all() or not np.isfinite(lengths).all():
        return uneven
    x, y, z = (rotation / lengths).T
    cosines = {"x and y": float(x @ y), "x and z": float(x @ z), "y and z": float(y @ z)}
    pair = max(cosines, key=lambda name: abs(cosines[name]))
    if abs(cosines[pair]) > TOLERANCE / 2:
        angle = np.degrees(np.arccos(np.clip(cosines[pair], -1, 1)))
        return f"its rotation is sheared: its axes {pair} are {angle:.4g} degrees apart; expected 90"
    determinant = float(_determinant(rotation))
    if determinant < 0:
        return f"its rotation is mirrored (determinant {determinant:.4g}); convert it to a right-handed frame"
    if lengths.max() - lengths.min() <= TOLERANCE * lengths.max():
        return f"its rotation is scaled by {float(lengths.mean()):.6g}; divide it by that"
    return uneven


def _row(values: Floats) -> str:
    return " ".join(f"{value:.6g}" for value in values)
