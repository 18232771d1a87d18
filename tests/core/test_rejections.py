"""Why points are rejected: each reason alone, and which comes first if several apply."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from properties import examples
from strategies import MODELS, SECOND_NS, START_NS, cells_of, clouds, limits, noises, scans, trajectories, turned

from roughmap import Limits, Noise, PointReason, RoughMap, Scan, Trajectory, georeference
from roughmap.cell import REASON_NAMES
from roughmap.settings import SURFACES

ORDER = (
    "not_finite", "no_return", "time", "no_pose", "self", "range", "ceiling", "covariance", "uncertain", "bounds",
)  # fmt: skip


def test_the_names_in_their_order() -> None:
    assert REASON_NAMES[1:] == ORDER
    assert [reason.name.lower() for reason in PointReason][1:] == list(ORDER)


def rejected_for(faults: set[str], model: str, moving: bool) -> dict[str, int]:
    """Return the result for a point with exactly these faults."""
    point = [3.0, 0.5, 0.2]
    if "no_return" in faults:
        point = [0.0, 0.0, 0.0]
    if "not_finite" in faults:
        point[1] = np.nan
    # All poses come after the point's time, or lie around it.
    stamps = START_NS + np.array([1, 2] if "no_pose" in faults else [-1, 1]) * SECOND_NS
    S = np.diag([1e-4] * 3 + [0.0] * 3)
    S[0, 0] = 100.0 if "uncertain" in faults else 1e-4
    S[2, 2] = -1e3 if "covariance" in faults else 1e-4
    way = Trajectory(stamps, np.zeros((2, 3)), np.tile((0, 0, 0, 1), (2, 1)), np.stack([S, S]))
    rules = Limits(
        min_range=20.0 if "range" in faults else 0.0,
        ceiling=-1.0 if "ceiling" in faults else np.inf,
        exclude=((-9, -9, -9, 9, 9, 9),) if "self" in faults else (),
    )
    bounds = (50, 50, 60, 60) if "bounds" in faults else (-9, -9, 9, 9)
    m = RoughMap(error_model=model, bounds=bounds, threads=1)
    offsets = np.array([-1 if "time" in faults else 0]) if moving else None
    report = m.add_scan(Scan([point], START_NS, offsets), way, Noise(0.01), rules)
    assert report.accepted + sum(report.rejected.values()) == 1
    assert (m.sequence, m.tile_count > 0) == (report.accepted, report.accepted == 1)
    return report.rejected


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("fault", ORDER)
def test_each_alone(fault: str, model: str) -> None:
    ignored = model == "point" and fault in ("covariance", "uncertain")
    assert rejected_for({fault}, model, moving=True) == ({} if ignored else {fault: 1})


@pytest.mark.parametrize("earlier", range(len(ORDER)))
def test_of_two_the_first_counts(earlier: int) -> None:
    for later in ORDER[earlier + 1 :]:
        assert rejected_for({ORDER[earlier], later}, "cuboid", moving=True) == {ORDER[earlier]: 1}


@examples(200)
@example(faults=set(ORDER), model="ellipsoid", moving=True)
@example(faults=set(), model="ellipsoid", moving=True)
@given(faults=st.sets(st.sampled_from(ORDER)), model=st.sampled_from(MODELS), moving=st.booleans())
def test_of_many_the_first_counts(faults: set[str], model: str, moving: bool) -> None:
    unseen = {"covariance", "uncertain"} if model == "point" else set()
    unseen |= set() if moving else {"time"}
    counted = [name for name in ORDER if name in faults - unseen]
    assert rejected_for(faults, model, moving) == ({counted[0]: 1} if counted else {})


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("model", MODELS)
def test_not_finite_on_either_way_in(axis: int, value: float, model: str) -> None:
    point = np.array([[1.0, 2.0, 3.0]])
    point[0, axis] = value
    m = RoughMap(error_model=model, threads=1)
    assert m.add(point, np.eye(3) * 1e-4).rejected == {"not_finite": 1}
    # A fault of the point precedes one of its covariance, its time or its position.
    fenced = RoughMap(error_model=model, threads=1, bounds=(50, 50, 60, 60))
    assert fenced.add(point, -np.eye(3), offsets_ns=[-1]).rejected == {"not_finite": 1}


def still(point: tuple[float, float, float], rules: Limits, **mounting: object) -> str:
    """Return why one point is rejected, for a robot at the map's origin."""
    way = Trajectory([0], [(0, 0, 0)], [(0, 0, 0, 1)], np.zeros((1, 6, 6)))
    _, _, reason, *_ = georeference(Scan([point], 0, **mounting), way, Noise(0.01), rules)
    return REASON_NAMES[reason[0]]


def test_limits_are_inclusive() -> None:
    """(3, 4, 12) is exactly 13 m away, 5 m of it horizontally."""
    p = (3.0, 4.0, 12.0)
    assert still(p, Limits(min_range=13.0, max_range=13.0)) == ""
    assert still(p, Limits(min_range=np.nextafter(13.0, 14.0))) == "range"
    assert still(p, Limits(max_range=np.nextafter(13.0, 12.0))) == "range"
    assert still(p, Limits(ceiling=2.0, ceiling_slope=2.0)) == ""
    assert still(p, Limits(ceiling=1.999, ceiling_slope=2.0)) == "ceiling"
    assert still(p, Limits(exclude=((0, 0, 0, 3, 4, 12),))) == "self"
    assert still(p, Limits(exclude=((0, 0, 0, 3, 4, 11.9), (3.1, 0, 0, 9, 9, 19)))) == ""


def test_boxes_are_in_the_robots_frame_and_the_ceiling_in_the_maps() -> None:
    """The sensor hangs upside down 1 m above the base: its (1, 0.5, 2) is (1, -0.5, -1) in the robot's frame."""
    mounting = {"translation": (0, 0, 1), "rotation": (1, 0, 0, 0)}
    assert still((1, 0.5, 2), Limits(exclude=((0.9, -0.6, -1.1, 1.1, -0.4, -0.9),)), **mounting) == "self"
    assert still((1, 0.5, 2), Limits(exclude=((0.9, 0.4, 1.9, 1.1, 0.6, 2.1),)), **mounting) == ""
    # 2 m below the sensor in the map, 2 m above it in the sensor's frame.
    assert still((1, 0.5, 2), Limits(ceiling=-1.9), **mounting) == ""
    assert still((1, 0.5, -2), Limits(ceiling=1.9), **mounting) == "ceiling"


def test_times() -> None:
    """Offsets from 0 to one second after the stamp; the sum stays below 2^32 s."""
    m = RoughMap(error_model="point", threads=1)
    report = m.add(np.zeros((4, 3)), stamp_ns=5, offsets_ns=[-1, 0, SECOND_NS, SECOND_NS + 1])
    assert (report.accepted, report.rejected) == (2, {"time": 2})
    end = 2**32 * SECOND_NS
    report = m.add(np.zeros((3, 3)), stamp_ns=end - 2, offsets_ns=[0, 1, 2])
    assert (report.accepted, report.rejected) == (2, {"time": 1})
    assert m.newest_updated == 2**32 - 1
    way = Trajectory([end - 9, end + 9], np.zeros((2, 3)), np.tile((0, 0, 0, 1), (2, 1)), np.zeros((2, 6, 6)))
    scan = Scan(np.ones((4, 3)), end - 2, np.array([-1, 0, 1, 2]))
    assert georeference(scan, way, Noise(0.01))[2].tolist() == [PointReason.TIME, 0, 0, PointReason.TIME]


def test_uncertain_is_measured_horizontally_and_with_coverage() -> None:
    """k = 2 and sigma 0.25 give exactly 0.5 m, which is allowed; along z is another limit, here none."""
    m = RoughMap(threads=1, coverage=2.0, max_horizontal_radius=0.5, max_vertical_sigma=np.inf)
    S = np.zeros((5, 3, 3))
    over = np.nextafter(0.25, 1.0)
    for n, sigma in enumerate([(0.25, 0.25, 0.1), (over, 0.1, 0.1), (0.1, over, 0.1), (0.1, 0.1, 9.0), (0, 0, 0)]):
        S[n] = np.diag(np.square(sigma))
    assert m.add(np.zeros((5, 3)), S).rejected == {"uncertain": 2}


@pytest.mark.parametrize("model", ["cuboid", "ellipsoid"])
@pytest.mark.parametrize("limit", [0.5, 0.03, 7.0])
def test_uncertain_is_measured_vertically_by_sigma(model: str, limit: float) -> None:
    """Coverage does not count, and the limit itself is allowed: a point beyond it says nothing about a height."""
    m = RoughMap(error_model=model, threads=1, coverage=3.0, max_vertical_sigma=limit)
    square = limit * limit
    S = np.array([np.diag([0.01, 0.01, z]) for z in (square, square * (1 + 1e-12), square * 4, 0.0)])
    report = m.add(np.zeros((4, 3)), S)
    assert (report.accepted, report.rejected) == (2, {"uncertain": 2})


def test_a_point_over_both_limits_counts_once() -> None:
    m = RoughMap(threads=1)
    assert m.add(np.zeros((1, 3)), np.eye(3) * 9.0).rejected == {"uncertain": 1}


def test_without_a_vertical_limit_any_height_goes() -> None:
    m = RoughMap(threads=1, max_vertical_sigma=np.inf)
    assert m.add(np.zeros((1, 3)), np.diag([0.01, 0.01, 1e6])).accepted == 1


@pytest.mark.parametrize("limit", [0.0, -1.0, np.nan])
def test_a_vertical_limit_is_a_number_above_zero(limit: float) -> None:
    with pytest.raises(ValueError, match="max_vertical_sigma: expected a number above 0, or infinity"):
        RoughMap(max_vertical_sigma=limit)


@pytest.mark.parametrize("model", ["cuboid", "ellipsoid"])
@examples(100)
@given(
    seed=st.integers(0, 2**32 - 1),
    sigma=st.sampled_from([(0.01, 0.02, 0.05), (1e-6, 1e-3, 0.05), (0.0, 0.0, 0.1), (0.0, 0.1, 0.1)]),
    below=st.sampled_from([0.0, -1e-10, -5e-10, -2e-9, -1e-6, -0.5]),
)
def test_eigenvalues_a_little_below_zero(
    model: str, seed: int, sigma: tuple[float, float, float], below: float
) -> None:
    """An eigenvalue down to -1e-9 of the trace is accepted; a lower one, in any direction, is not."""
    axes = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    S = turned(axes, np.asarray(sigma))
    least = axes[:, 0]
    S += (below * np.trace(S) - sigma[0] ** 2 * (below < 0)) * np.outer(least, least)
    S = (S + S.T) / 2
    report = RoughMap(error_model=model, threads=1).add([(0.05, 0.05, 1.0)], S)
    refused = below < -1e-9 or (np.diag(S) < 0).any()
    assert report.rejected == ({"covariance": 1} if refused else {})


@pytest.mark.parametrize("model", ["cuboid", "ellipsoid"])
def test_only_the_upper_triangle_is_read(model: str) -> None:
    whole = np.array([[4, 1, 1], [1, 9, 2], [1, 2, 5]]) * 1e-4
    upper = np.triu(whole)
    upper[1, 0] = upper[2, 0] = upper[2, 1] = np.nan
    made = []
    for S in (whole, upper):
        m = RoughMap(error_model=model, threads=1)
        assert m.add([(0.09, 0.09, 1.0)], S).rejected == {}
        made.append(m.digest())
    assert made[0] == made[1]
    broken = np.where(np.eye(3, k=1, dtype=bool), np.nan, whole)
    assert RoughMap(error_model=model, threads=1).add([(0, 0, 0)], broken).rejected == {"covariance": 1}


@examples(100)
@given(cloud=clouds(), model=st.sampled_from(MODELS), bounded=st.booleans())
def test_every_point_is_counted_once(
    cloud: tuple[np.ndarray, np.ndarray, np.ndarray], model: str, bounded: bool
) -> None:
    points, S, stamps = cloud
    box = (*(np.nanmin(points[:, :2], axis=0) - 0.1), *(np.nanmax(points[:, :2], axis=0) - 0.01)) if bounded else None
    m = RoughMap(error_model=model, threads=1, bounds=box)
    report = m.add(points, S, stamps)
    assert report.accepted + sum(report.rejected.values()) == len(points)
    assert all(report.rejected.values())
    assert m.sequence == (report.accepted > 0)


@examples(100)
@given(
    scan=scans(),
    way=trajectories(),
    noise=noises,
    rules=limits,
    model=st.sampled_from(MODELS),
    surface=st.sampled_from(SURFACES),
)
def test_every_return_is_counted_once(
    scan: Scan, way: Trajectory, noise: Noise, rules: Limits, model: str, surface: str
) -> None:
    m = RoughMap(error_model=model, surface=surface, threads=1)
    report = m.add_scan(scan, way, noise, rules)
    assert report.accepted + sum(report.rejected.values()) == len(scan.points)
    early = Counter(REASON_NAMES[n] for n in georeference(scan, way, noise, rules)[2].tolist() if n)
    later = {"covariance", "uncertain", "bounds"}
    assert {name: n for name, n in report.rejected.items() if name not in later} == dict(early)
    if surface == "all":  # the ground's cells don't count what stands on it
        assert sum(int(cell["count"]) for cell in cells_of(m).values()) >= report.accepted


@examples(200)
@given(
    limit=st.one_of(
        st.floats(0.0, 100.0), st.floats(0.0, np.inf), st.sampled_from([0.0, 5e-324, 1e-160, 1e200, np.inf])
    ),
    seed=st.integers(0, 2**32 - 1),
)
def test_squares_of_ranges_are_judged_as_their_roots(limit: float, seed: int) -> None:
    low, high = Limits(min_range=limit, max_range=limit).squares
    near = np.minimum(np.array([limit * limit, low, high]), 1e308)
    steps = np.arange(-3, 4)
    squares = [np.maximum(near + step * np.spacing(near), 0.0) for step in steps]
    squares.append(10.0 ** np.random.default_rng(seed).uniform(-320, 308, 50))
    square = np.concatenate([*squares, [0.0, np.inf]])
    assert np.array_equal(square < low, np.sqrt(square) < limit)
    assert np.array_equal(square > high, np.sqrt(square) > limit)
