"""The map grown point by point against the batch builder: all layers, all error models, any settings."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from properties import examples
from two_methods import compare

from roughmap.map import RoughMap
from roughmap.points.footprint import ERROR_MODELS
from roughmap.reference.batch import BatchMap


@st.composite
def clouds(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Up to 60 points on a few square metres, covariances of any shape and direction, stamps."""
    number = draw(st.integers(1, 60))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    centre = draw(st.sampled_from([(0.0, 0.0, 0.0), (12.3, -45.6, 7.0), (-0.05, 6.4, 800.0)]))
    points = np.asarray(centre) + rng.normal(0.0, draw(st.sampled_from([0.02, 0.2, 1.0])), (number, 3))
    if draw(st.booleans()):
        points[:, 2] = np.round(points[:, 2], 1)  # equal heights
    turn, _ = np.linalg.qr(rng.normal(size=(number, 3, 3)))
    sigma = np.exp(rng.uniform(np.log(1e-3), np.log(draw(st.sampled_from([0.01, 0.05, 0.2]))), (number, 3)))
    covariance = np.einsum("nij,nj,nkj->nik", turn, sigma**2, turn)
    stamp_ns = rng.integers(0, 100 * 10**9, number)
    return points, covariance, stamp_ns


@pytest.mark.parametrize("model", ERROR_MODELS)
@examples(60)
@given(
    cloud=clouds(),
    cell_size=st.sampled_from([0.1, 0.25, 1.0]),
    coverage=st.sampled_from([1.0, 2.0, 3.0]),
    min_radius=st.sampled_from([1e-3, 0.01]),
    min_share=st.sampled_from([0.05, 0.3]),
    bounded=st.booleans(),
    cuts=st.lists(st.integers(0, 60), max_size=3),
)
def test_all_layers(
    model: str,
    cloud: tuple[np.ndarray, np.ndarray, np.ndarray],
    cell_size: float,
    coverage: float,
    min_radius: float,
    min_share: float,
    bounded: bool,
    cuts: list[int],
) -> None:
    points, covariance, stamp_ns = cloud
    common = {
        "cell_size": cell_size,
        "error_model": model,
        "coverage": coverage,
        "min_radius": min_radius,
        "bounds": (*(points.min(axis=0)[:2] - 0.01), *points.mean(axis=0)[:2]) if bounded else None,
    }
    read = {"height_tolerance": 0.03, "limits": {"slope": 1.0, "step": 0.5, "std_dev": 0.2, "range": 0.6}}
    b = BatchMap(points, covariance, stamp_ns, min_share=min_share, **common, **read)
    # A cell whose share is within rounding of the smallest that counts may be in one map and not in the other.
    nearly = [BatchMap(points, covariance, min_share=min_share * f, **common)["count"] for f in (1 - 1e-8, 1 + 1e-8)]
    assume(len(nearly[0]) == len(nearly[1]) and (nearly[0] == nearly[1]).all())
    m = RoughMap(min_share=min_share, surface="all", threads=1, **common)
    accepted, rejected = 0, dict.fromkeys(b.rejected, 0)
    for part in np.split(np.arange(len(points)), sorted(cuts)):
        report = m.add(points[part], None if model == "point" else covariance[part], stamp_ns[part])
        accepted += report.accepted
        for reason, number in report.rejected.items():
            rejected[reason] += number
    assert (accepted, rejected) == (b.accepted, b.rejected)
    compare(m, b, np.abs(points[:, 2]).max(), **read)


@pytest.mark.parametrize("model", ERROR_MODELS)
def test_both_reject_the_same_points(model: str) -> None:
    rng = np.random.default_rng(8)
    points = rng.uniform(-2.0, 2.0, (3000, 3))
    factors = rng.normal(0.0, 0.1, (3000, 3, 3))
    covariance = factors @ factors.swapaxes(1, 2)
    covariance[::7] -= 0.02 * np.eye(3)
    covariance[::11, 0, 2] = np.nan
    points[::13, 2] = np.inf
    settings_ = {"error_model": model, "bounds": (-1.5, -1.9, 1.7, 1.1)}
    b = BatchMap(points, covariance, **settings_)
    report = RoughMap(threads=1, **settings_).add(points, covariance)
    assert (report.accepted, report.rejected) == (b.accepted, b.rejected)
    reasons = {"not_finite", "bounds"} if model == "point" else {"not_finite", "bounds", "covariance", "uncertain"}
    assert set(b.rejected) == reasons


@pytest.mark.parametrize("model", ERROR_MODELS)
def test_the_same_covariance_for_all(model: str) -> None:
    rng = np.random.default_rng(9)
    points = rng.uniform(-2.0, 2.0, (2000, 3))
    S = np.array([[4.0, 1.0, 0.5], [1.0, 9.0, 0.0], [0.5, 0.0, 1.0]]) * 1e-4
    m = RoughMap(error_model=model, surface="all", threads=1)
    m.add(points, S)
    compare(m, BatchMap(points, S, error_model=model), 2.0)
