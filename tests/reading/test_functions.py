"""The layers' own functions against those of scipy and the C library."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import special, stats

from roughmap.jit import kernel
from roughmap.reading import functions
from roughmap.reading.functions import atan, erf, student_95, student_within

FREEDOM = np.concatenate(([2.0, 2.0 + 1e-9], np.geomspace(2.001, 1e6, 300), [1e9, 1e15, 1e300, math.inf]))
T = np.concatenate(([0.0], np.geomspace(1e-12, 1e6, 700), np.linspace(0.0, 12.0, 600)))


@kernel
def _over(x: np.ndarray, y: np.ndarray, erfs: np.ndarray, atans: np.ndarray, within: np.ndarray) -> None:
    for n in range(len(x)):
        erfs[n] = erf(x[n])
        atans[n] = atan(x[n])
        within[n] = student_within(x[n], y[n])


def over(x: np.ndarray, freedom: np.ndarray | float = 2.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    out = np.empty((3, len(x)))
    _over(x, np.broadcast_to(np.float64(freedom), x.shape).copy(), *out)
    return out[0], out[1], out[2]


def true_within(t: np.ndarray, freedom: float) -> np.ndarray:
    """From the incomplete beta function, which keeps its digits where ``freedom`` is large."""
    return special.erf(t / math.sqrt(2.0)) if freedom > 1e14 else 1.0 - 2.0 * stats.t.sf(t, freedom)


def test_erf_and_atan_over_their_range() -> None:
    x = np.concatenate(([0.0], np.geomspace(1e-300, 1e300, 4000), np.linspace(0.0, 8.0, 20_000), [math.inf]))
    erfs, atans, _ = over(x)
    assert np.abs(erfs - special.erf(x)).max() < 2e-10
    assert np.abs(atans - np.arctan(x)).max() < 1e-11
    assert (erfs[-1], erfs[0], atans[0]) == (1.0, 0.0, 0.0)
    assert atans[-1] == math.pi / 2


def test_they_grow() -> None:
    """But for the last bits, where an arc tangent begins to be measured from another angle."""
    x = np.linspace(0.0, 6.0, 100_001)
    erfs, atans, _ = over(x)
    assert np.diff(erfs).min() > -1e-15
    assert np.diff(atans).min() > -1e-11


def test_nan_stays_nan() -> None:
    for values in over(np.array([math.nan])):
        assert np.isnan(values).all()
    assert math.isnan(student_95(math.nan))
    assert math.isnan(student_within(1.0, math.nan))


@pytest.mark.parametrize("freedom", FREEDOM[::7].tolist())
def test_student_by_freedom(freedom: float) -> None:
    got = over(T, freedom)[2]
    expected = true_within(T, freedom)
    assert np.abs(got - expected).max() < 3e-5
    assert got.min() == 0.0
    assert got.max() <= 1.0


@given(st.floats(2.0, 1e308), st.floats(0.0, allow_infinity=True))
def test_student_anywhere(freedom: float, t: float) -> None:
    expected = float(true_within(np.array([min(t, 1e7)]), freedom)[0])
    assert float(student_within(t, freedom)) == pytest.approx(expected, rel=0, abs=3e-5)


@given(st.floats(2.0, 1e308), st.floats(0.0, 1e3), st.floats(1e-3, 1.0))
def test_student_grows_with_t(freedom: float, t: float, more: float) -> None:
    """A surer cell is never less confident."""
    assert float(student_within(t + more, freedom)) >= float(student_within(t, freedom)) - 1e-15


def test_the_95_percent_point() -> None:
    got = np.array([student_95(freedom) for freedom in FREEDOM])
    expected = np.where(FREEDOM > 1e14, stats.norm.isf(0.025), stats.t.isf(0.025, np.minimum(FREEDOM, 1e14)))
    assert np.abs(got / expected - 1.0).max() < 3e-6


@given(st.floats(1e-300, 1.5707963))
def test_tangent(x: float) -> None:
    # near pi / 2 the tangent magnifies the rounding of the angle
    assert functions.tan(x) == pytest.approx(math.tan(x), rel=1e-14 + 1e-15 * math.tan(x))


def test_tangents_beyond_a_right_angle() -> None:
    assert functions.tan(math.pi / 2) == functions.tan(3.0) == functions.tan(1e300) == math.inf
