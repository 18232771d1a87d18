"""Shares of a point in cells (eq. 12): they add up to 1, and agree with quadrature or plain overlap."""

from fractions import Fraction
from math import floor, pi, sqrt

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from strategies import CENTRES, WEIGHTED, cells_of, covariances, points, shares_of, turned

from roughmap import RoughMap

NODES, FACTORS = np.polynomial.legendre.leggauss(48)

K, LEAST = 2.0, 1e-3
"""Coverage and smallest radius of all maps in this file."""


def one_point(model: str, where: np.ndarray, S: np.ndarray, **options: object) -> RoughMap:
    m = RoughMap(error_model=model, coverage=K, min_radius=LEAST, min_share=0.0, threads=1, **options)
    report = m.add(where.reshape(1, 3), S)
    assert report.accepted == 1
    return m


def solid(S: np.ndarray) -> np.ndarray:
    """Return S with its eigenvalues raised to at least (min_radius / k)^2."""
    values, axes = np.linalg.eigh(S)
    least = (LEAST / K) ** 2
    return S if values[0] >= least else (axes * np.maximum(values, least)) @ axes.T


def ellipse_in(S: np.ndarray, left: float, right: float, bottom: float, top: float) -> float:
    """Return the share of the k-sigma ellipse of S around 0 in a rectangle, by Gauss-Legendre quadrature.

    In u = x / (k sx) = sin t the chord runs from rho u - beta cos t to rho u + beta cos t. It is smooth except where an
    arc meets a side, and the integral is split there.
    """
    ex, ey = K * sqrt(S[0, 0]), K * sqrt(S[1, 1])
    rho = S[0, 1] / sqrt(S[0, 0] * S[1, 1])
    beta = sqrt(np.linalg.det(S[:2, :2]) / (S[0, 0] * S[1, 1]))
    left, right, bottom, top = left / ex, right / ex, bottom / ey, top / ey
    cuts = [max(left, -1.0), min(right, 1.0)]
    if cuts[0] >= cuts[1]:
        return 0.0
    for v in (bottom, top):
        if abs(v) < 1.0:
            cuts += [u for sign in (-1, 1) if cuts[0] < (u := rho * v + sign * beta * sqrt(1 - v * v)) < cuts[1]]
    t = np.arcsin(np.sort(cuts))
    middle, half = (t[1:] + t[:-1]) / 2, (t[1:] - t[:-1]) / 2
    t = middle[:, None] + half[:, None] * NODES
    arc, u = beta * np.cos(t), np.sin(t)
    chord = np.clip(np.minimum(rho * u + arc, top) - np.maximum(rho * u - arc, bottom), 0.0, None)
    return float((half[:, None] * FACTORS * chord * np.cos(t)).sum() / (pi * beta))


def check_ellipse(where: np.ndarray, S: np.ndarray, a: float) -> int:
    """Check all shares of one ellipse; return its number of cells."""
    shares = shares_of(one_point("ellipsoid", where, S, cell_size=a))
    body = solid(S)
    # A needle of 0.5 m by 1e-3 m has beta 2e-3: areas in its units are off by 1e-16 over beta. The position relative to
    # the cell's edge is off by the spacing of floats there, over the half width.
    beta = sqrt(max(np.linalg.det(body[:2, :2]) / (body[0, 0] * body[1, 1]), 1e-12))
    narrow = K * sqrt(np.linalg.eigvalsh(body[:2, :2])[0])
    off = 1e-13 / beta + 4 * np.spacing(np.abs(where[:2]).max() + 1.0) / narrow
    assert sum(shares.values()) == pytest.approx(1.0, abs=1e-11 + len(shares) * 1e-12)
    reach = [K * sqrt(body[axis, axis]) for axis in (0, 1)]
    first = [floor((where[axis] - reach[axis]) / a) - 1 for axis in (0, 1)]
    last = [floor((where[axis] + reach[axis]) / a) + 1 for axis in (0, 1)]
    for i in range(first[0], last[0] + 1):
        for j in range(first[1], last[1] + 1):
            edges = i * a - where[0], (i + 1) * a - where[0], j * a - where[1], (j + 1) * a - where[1]
            assert shares.get((i, j), 0.0) == pytest.approx(ellipse_in(body, *edges), abs=off + 2e-12), (i, j)
    return len(shares)


@settings(deadline=None, max_examples=150)
@given(data=st.data(), a=st.sampled_from([0.02, 0.1, 0.25, 1.0]))
def test_ellipses(data: st.DataObject, a: float) -> None:
    """Round, flat and needle-like ellipses, at the origin and in UTM."""
    where = data.draw(points(1))[0]
    S = data.draw(covariances(1, 1e-4, 0.2))[0]
    check_ellipse(where, S, a)


@settings(deadline=None, max_examples=100)
@given(
    dx=st.sampled_from([0.0, 1e-15, 1e-9, 1e-4, -1e-4, 0.00999999, 0.0100001, -0.01]),
    dy=st.sampled_from([0.0, 1e-12, 1e-5, -0.0199999, 0.02]),
    angle=st.sampled_from([0.0, 1e-9, 0.3, pi / 4, pi / 2]),
)
def test_slivers(dx: float, dy: float, angle: float) -> None:
    """Half widths 0.02 and 0.01 near a corner of four cells: the ellipse touches, barely crosses or misses sides."""
    c, s = np.cos(angle), np.sin(angle)
    S = turned(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.array([0.005, 0.01, 0.02]))
    check_ellipse(np.array([0.5 + dx, -0.25 + dy, 1.0]), S, 0.25)


def test_an_ellipse_inside_one_cell_is_whole() -> None:
    S = turned(np.eye(3), np.array([0.01, 0.02, 0.05]))
    assert shares_of(one_point("ellipsoid", np.array([0.55, -0.25, 1.0]), S)) == {(5, -3): 1.0}


def test_a_cell_inside_an_ellipse_is_filled() -> None:
    """A cell inside the ellipse has its area over pi k^2 sx sy as share; the ellipse covers about 2,000 cells."""
    S = turned(np.eye(3), np.array([0.2, 0.15, 0.05]))
    where = np.array([0.013, 0.007, 1.0])
    shares = shares_of(one_point("ellipsoid", where, S, cell_size=0.02))
    assert shares[0, 0] == pytest.approx(0.02**2 / (pi * 0.4 * 0.3), rel=1e-9)  # 1e-12 of a share of 1e-3
    assert check_ellipse(where, S, 0.02) > 900


@pytest.mark.parametrize("rho", [0.9999, 1 - 1e-9, 1.0, -1.0])
def test_near_degenerate_ellipses(rho: float) -> None:
    """A line from corner to corner: the smallest radius makes it 1 mm thick, and its shares add up."""
    S = np.diag([0.01, 0.01, 0.01])
    S[0, 1] = S[1, 0] = rho * 0.01
    check_ellipse(np.array([0.05, 0.02, 1.0]), S, 0.1)


def test_no_spread_at_all_is_a_small_sphere() -> None:
    """Zero sigmas are raised to 1 mm: on a border half lies left and half right."""
    shares = shares_of(one_point("ellipsoid", np.array([0.25, 0.1, 1.0]), np.zeros((3, 3)), cell_size=0.25))
    assert shares == {(0, 0): pytest.approx(0.5, abs=1e-13), (1, 0): pytest.approx(0.5, abs=1e-13)}


@settings(deadline=None, max_examples=150)
@example(where=np.array([0.75, -0.25, 0.0]), sigma=(0.125, 0.0625), a=0.25)
@given(
    where=points(1).map(lambda p: p[0]), sigma=st.tuples(*[st.floats(1e-4, 0.2)] * 2), a=st.sampled_from([0.1, 0.25])
)
def test_cuboids(where: np.ndarray, sigma: tuple[float, float], a: float) -> None:
    """The overlap in exact fractions, of the same edges (the float products i*a) and radii."""
    shares = shares_of(one_point("cuboid", where, np.diag([*np.square(sigma), 1e-4]), cell_size=a))
    assert sum(shares.values()) == pytest.approx(1.0, abs=1e-14 + len(shares) * 1e-12)
    radius = [max(K * sqrt(s * s), LEAST) for s in sigma]
    parts = []
    for axis in (0, 1):
        x, r = Fraction(float(where[axis])), Fraction(radius[axis])
        first = floor((where[axis] - radius[axis]) / a)
        line = {}
        for i in range(first - 1, floor((where[axis] + radius[axis]) / a) + 2):
            # The edges are products of floats, as in the contract.
            low, high = max(Fraction(i * a), x - r), min(Fraction((i + 1) * a), x + r)
            line[i] = max(high - low, Fraction(0)) / (2 * r)
        parts.append(line)
    # Two differences of floats, each off by half a spacing, over the width.
    off = 2e-15 + 2 * np.spacing(np.abs(where[:2]).max() + 1) / min(radius)
    for i, px in parts[0].items():
        for j, py in parts[1].items():
            assert shares.get((i, j), 0.0) == pytest.approx(float(px * py), abs=off + 1.01e-12), (i, j)


@pytest.mark.parametrize("model", WEIGHTED)
@settings(deadline=None, max_examples=60)
@given(
    data=st.data(),
    min_share=st.sampled_from([0.02, 0.05, 0.3, 1.0]),
    centre=st.sampled_from(CENTRES),
)
def test_min_share_leaves_out_and_changes_nothing_else(
    model: str, data: st.DataObject, min_share: float, centre: tuple[float, float, float]
) -> None:
    """Cells that count have the same bytes as with 0; the others have less than min_share of the largest share."""
    where = data.draw(points(1, [centre]))[0]
    S = data.draw(covariances(1, 1e-3, 0.2))[0]
    all_cells = cells_of(one_point(model, where, S))
    m = RoughMap(error_model=model, coverage=K, min_radius=LEAST, min_share=min_share, threads=1)
    m.add([where], S)
    cells = cells_of(m)
    largest = max(cell["weight"] for cell in all_cells.values())
    assert cells
    for place, cell in all_cells.items():
        if place in cells:
            assert cells[place].tobytes() == cell.tobytes()
            assert cell["weight"] >= largest * min_share * (1 - 1e-14)
        else:
            assert cell["weight"] <= largest * min_share * (1 + 1e-14)
    assert cells.keys() <= all_cells.keys()
