"""Quaternions of turns and matrices: what scipy says."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roughmap_schemas.geometry import quaternion_of
from roughmap_service.simulation.rover import exponential

TURNS = [
    (0.0, 0.0, 0.0),
    (1e-9, -2e-9, 0.0),
    (0.01, 0.02, -0.03),
    (np.pi, 0.0, 0.0),
    (0.0, -np.pi, 0.0),
    (0.0, 0.0, 3.1),
    (-1.2, 2.0, 0.7),
]


def same(ours: tuple[float, float, float, float], theirs: np.ndarray) -> bool:
    """Equal but for the sign, which is no other rotation, and a few units in the last place."""
    return bool(abs(abs(np.dot(ours, theirs)) - 1) < 1e-15 * 8 and abs(np.linalg.norm(ours) - 1) < 1e-15 * 8)


@pytest.mark.parametrize("turn", TURNS)
def test_exponential_and_quaternion_of(turn: tuple[float, float, float]) -> None:
    there = Rotation.from_rotvec(turn)
    assert same(exponential(np.array(turn)), there.as_quat())
    assert same(quaternion_of(there.as_matrix().tolist()), there.as_quat())


def test_small_turns_keep_their_digits() -> None:
    """The product above can't see them: half of each part, but for a square of it."""
    np.testing.assert_allclose(exponential(np.array([1e-9, -2e-9, 4e-9])), [5e-10, -1e-9, 2e-9, 1.0], rtol=1e-15)


def test_a_rounded_matrix() -> None:
    """float32's rounding, as recordings have it: the quaternion is a unit one and off by no more than that."""
    there = Rotation.from_rotvec((0.3, -2.5, 1.0))
    ours = quaternion_of(there.as_matrix().astype(np.float32).astype(np.float64).tolist())
    assert abs(np.linalg.norm(ours) - 1) < 1e-15 * 8
    assert abs(abs(np.dot(ours, there.as_quat())) - 1) < 1e-12  # the square of 1e-7 and some
