"""Answers without a division agree with the exact way wherever they claim to be sure."""

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from strategies import CENTRES, WEIGHTED, random_axes, seeds, turned

from roughmap import RoughMap
from roughmap.points.bodies import is_covariance
from roughmap.points.doubt import is_floor_in_doubt, is_surely_covariance
from roughmap.points.place import BLOCK

NUMBER = 20_000
UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])


@numba.njit(error_model="numpy")
def floors(v: np.ndarray, a: float, doubt: np.ndarray, differs: np.ndarray) -> None:
    inverse = 1.0 / a
    for n in range(len(v)):
        t = v[n] * inverse
        doubt[n] = is_floor_in_doubt(t)
        differs[n] = np.floor(t) != np.floor(v[n] / a)


@numba.njit(error_model="numpy")
def judgements(m: np.ndarray, sure: np.ndarray, exact: np.ndarray) -> None:
    for n in range(len(m)):
        sure[n] = is_surely_covariance(m[n, 0], m[n, 1], m[n, 2], m[n, 3], m[n, 4], m[n, 5])
        exact[n] = is_covariance(m[n, 0], m[n, 1], m[n, 2], m[n, 3], m[n, 4], m[n, 5])


@examples(200)
@given(
    seed=seeds,
    a=st.one_of(st.sampled_from([0.1, 0.05, 0.25, 1.0 / 3.0, 1.0]), st.floats(1e-30, 1e30)),
    reach=st.sampled_from([1.0, 1e3, 1e7, 2.0**31, 1e14, 1e300]),
)
def test_a_floor_beyond_doubt_is_that_of_the_quotient(seed: int, a: float, reach: float) -> None:
    """Coordinates anywhere, on the borders of cells, and the numbers next to these."""
    rng = np.random.default_rng(seed)
    v = rng.uniform(-1.0, 1.0, NUMBER) * min(reach * a, 1e300)
    v[: NUMBER // 2] = np.round(v[: NUMBER // 2] / a) * a
    for _ in range(4):
        chosen = rng.random(NUMBER // 2) < 0.4
        v[: NUMBER // 2][chosen] = np.nextafter(v[: NUMBER // 2][chosen], rng.choice([-np.inf, np.inf]))
    doubt, differs = np.zeros((2, NUMBER), np.bool_)
    floors(v, a, doubt, differs)
    assert not (differs & ~doubt).any()
    if reach <= 2.0**31:
        assert doubt[NUMBER // 2 :].mean() < 0.001  # else the exact way would be the usual one


def test_floors_differ_without_the_margin() -> None:
    """The doubts are needed, and cover what has no place."""
    v = np.concatenate([np.arange(1.0, 10_000.0) * 0.1, [np.inf, -np.inf, np.nan, 1e308]])
    doubt, differs = np.zeros((2, len(v)), np.bool_)
    floors(v, 0.1, doubt, differs)
    assert differs[:-4].any()
    assert doubt.all()


@st.composite
def matrices(draw: st.DrawFn) -> np.ndarray:
    """(NUMBER, 6) upper triangles on either side of what passes: nearly singular, indefinite, of any scale."""
    rng = np.random.default_rng(draw(seeds))
    thin = 10.0 ** rng.uniform(-10.0, 0.0, (NUMBER, 3))
    S = turned(random_axes(rng, NUMBER), np.sqrt(thin))
    shift = draw(st.sampled_from([0.0, 1e-9, 1e-6, 1e-3]))
    S -= np.eye(3) * (shift * np.trace(S, axis1=1, axis2=2) * rng.uniform(0.0, 2.0, NUMBER))[:, None, None]
    scale = 10.0 ** (draw(st.sampled_from([0.0, 3.0, 60.0, 150.0])) * rng.uniform(-1.0, 1.0, (NUMBER, 3)))
    m = (S * scale[:, :, None] * scale[:, None, :])[:, *UPPER]
    wild = rng.random(m.shape) < draw(st.sampled_from([0.0, 0.01]))
    m[wild] *= rng.choice([-1.0, 0.0, 1e5, 1e160, np.inf, np.nan], wild.sum())
    return m


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@examples(150)
@given(m=matrices())
def test_a_sure_covariance_passes(m: np.ndarray) -> None:
    sure, exact = np.zeros((2, len(m)), np.bool_)
    judgements(m, sure, exact)
    assert not (sure & ~exact).any()


def test_usual_covariances_are_sure() -> None:
    rng = np.random.default_rng(3)
    m = turned(random_axes(rng, NUMBER), rng.uniform(0.003, 0.3, (NUMBER, 3)))[:, *UPPER]
    sure, exact = np.zeros((2, len(m)), np.bool_)
    judgements(m, sure, exact)
    assert sure.all()
    assert exact.all()


@st.composite
def grounds(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Four blocks of points, some on the borders of cells, with covariances of which a few are nearly singular."""
    number = 4 * BLOCK
    rng = np.random.default_rng(draw(seeds))
    where = np.asarray(draw(st.sampled_from(CENTRES))) + rng.normal(0, 3.0, (number, 3))
    sigma = np.exp(rng.uniform(np.log(1e-3), np.log(0.1), (number, 3)))
    axes = random_axes(rng, number)
    if draw(st.booleans()):
        # Extents that end on borders of cells, or next to them.
        axes[:] = np.eye(3)
        sigma[:] = rng.choice([0.025, 0.05], (number, 3))
        on = rng.random(where.shape) < draw(st.sampled_from([0.01, 0.5]))
        where[on] = np.round(where[on] / 0.1) * 0.1
        where = np.where(rng.random(where.shape) < 0.5, where, np.nextafter(where, np.inf))
    sigma[rng.random(number) < draw(st.sampled_from([0.0, 0.002])), 0] = 1e-7
    return where, turned(axes, sigma)


def apart(m: RoughMap, tile: tuple[int, int]) -> dict[tuple[int, int], bytes]:
    """All tiles of a map but one."""
    with m.freeze() as frozen:
        return {(x, y): frozen.records(x, y).tobytes() for x, y in frozen.tiles.tolist() if (x, y) != tile}


@examples(60)
@given(ground=grounds(), model=st.sampled_from(WEIGHTED))
def test_a_doubt_changes_no_other_point_of_its_block(ground: tuple[np.ndarray, np.ndarray], model: str) -> None:
    """The last point of each block lies apart. It sends its whole block the exact way if its covariance is zero."""
    where, S = ground
    far = np.array([-100.03, -100.03, 0.0])
    where[BLOCK - 1 :: BLOCK] = far
    tile = (int(far[0] / 0.1) // 64, int(far[1] / 0.1) // 64)
    seen = []
    for variance in (1e-6, 0.0):
        S[BLOCK - 1 :: BLOCK] = np.eye(3) * variance
        m = RoughMap(error_model=model, threads=1)
        assert m.add(where, S).accepted >= 4
        seen.append(apart(m, tile))
    assert seen[0] == seen[1]
