"""The doctor's measures, each by itself: stamps, the difference of clocks, losses, figures of clouds."""

import numpy as np
import pytest
from doctor_traffic import NOW
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap_schemas.messages import CloudCounts, MapStatus, PointCounts, PoseCounts
from roughmap_schemas.reasons import CloudReason, PointReason, Refusal
from roughmap_service.cli.doctor.clocks import moved_s, offset_s
from roughmap_service.cli.doctor.findings import table
from roughmap_service.cli.doctor.heard import Heard
from roughmap_service.cli.doctor.numbering import Numbers
from roughmap_service.cli.doctor.service import judge_service
from roughmap_service.cli.doctor.stamps import clean, course
from roughmap_service.cli.doctor.survey import survey

S = 10**9
RATES = st.floats(4.0, 200.0)
SEEDS = st.integers(0, 2**32 - 1)


def stream(hz: float, seed: int, *, seconds: float = 4.0, jitter_s: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Arrivals in order, and rising stamps, in ns."""
    stamps = NOW + (np.arange(round(seconds * hz)) / hz * S).astype(np.int64)
    late = np.random.default_rng(seed).uniform(0.0, jitter_s * S, len(stamps)).astype(np.int64)
    return np.maximum.accumulate(stamps + late), stamps


def heard(arrivals: np.ndarray, stamps: np.ndarray) -> list[Heard]:
    return [Heard(int(a), int(s)) for a, s in zip(arrivals, stamps, strict=True)]


@examples(100)
@given(RATES, SEEDS)
def test_stamps_that_rise_have_no_fault(hz: float, seed: int) -> None:
    arrivals, stamps = stream(hz, seed)
    found = course(heard(arrivals, stamps))
    assert (found.unset, found.repeated, found.wild, found.late, found.steps) == (0, 0, [], 0, [])
    assert found.rows == [list(range(len(stamps)))]


@examples(150)
@given(RATES, SEEDS, st.floats(0.05, 1e4), st.booleans(), st.floats(0.3, 0.6))
def test_a_clock_that_is_set(hz: float, seed: int, by: float, ahead: bool, where: float) -> None:
    arrivals, stamps = stream(hz, seed, jitter_s=0.02)
    cut = int(len(stamps) * where)
    by = 2.0 + by if ahead else max(by, 2.5 / hz)  # smaller leaps ahead are gaps
    stamps[cut:] += round(by * S) * (1 if ahead else -1)
    found = course(heard(arrivals, stamps))
    assert (found.wild, found.late) == ([], 0)
    (step,) = found.steps
    assert abs(step / S - (by if ahead else -by)) < 1.0 / hz + 0.03
    assert [row[0] for row in found.rows] == [0, cut]


@examples(150)
@given(RATES, SEEDS, st.floats(2.0, 1e5), st.booleans(), st.data())
def test_single_wild_stamps(hz: float, seed: int, off: float, ahead: bool, data: st.DataObject) -> None:
    arrivals, stamps = stream(hz, seed)
    places = data.draw(st.sets(st.integers(1, len(stamps) // 4 - 2), min_size=1, max_size=4))
    wild = [4 * place for place in places]  # never two in a row
    stamps[wild] += round(off * S) * (1 if ahead else -1)
    messages = heard(arrivals, stamps)
    found = course(messages)
    assert len(found.wild) == len(wild)
    assert all(abs(abs(one) / S - off) < 0.2 for one in found.wild)
    assert len(clean(messages, found)) == len(stamps) - len(wild), "the others are good"
    assert found.steps == []


@examples(100)
@given(RATES, RATES, SEEDS, st.floats(-1e5, 1e5), st.floats(0.0, 0.2), st.floats(0.0, 0.2))
def test_the_difference_of_two_clocks(
    hz: float, scans_hz: float, seed: int, ahead: float, pose_late: float, cloud_late: float
) -> None:
    arrivals, stamps = stream(hz, seed)
    poses = heard(arrivals + round(pose_late * S), stamps)
    arrivals, stamps = stream(scans_hz, seed + 1)
    clouds = heard(arrivals + round(cloud_late * S), stamps + round(ahead * S))
    offset = offset_s(clouds, poses)
    assert offset is not None
    assert abs(offset - (ahead + pose_late - cloud_late)) < 0.06, "up to the jitter of the arrivals"


@examples(60)
@given(st.floats(10.0, 200.0), st.floats(10.0, 50.0), SEEDS, st.floats(0.3, 30.0))
def test_a_clock_that_moves_alone(hz: float, scans_hz: float, seed: int, by: float) -> None:
    poses = heard(*stream(hz, seed))
    arrivals, stamps = stream(scans_hz, seed + 1)
    assert abs(moved_s(heard(arrivals, stamps), poses)) < 0.06
    by = min(by, 0.45)  # above, the stamps do not advance with the arrivals, and the step itself is told
    stamps[len(stamps) // 2 :] += round(by * S)
    assert abs(moved_s(heard(arrivals, stamps), poses) - by) < 0.1


def test_too_few_messages_tell_nothing() -> None:
    assert offset_s([], []) is None
    assert offset_s([Heard(NOW, NOW)], []) is None
    assert course([]).rows == []
    assert course([Heard(NOW, 0)]).unset == 1


@pytest.mark.parametrize(
    ("numbers", "lost"),
    [
        ([5, 6, 7, 8], 0),
        ([5, 6, 9], 2),
        ([1000, 1001, 0, 1, 2], 0),  # restarted
        ([500, 0, 501, 1, 502, 2, 503, 3], 0),  # two publishers
        ([0, 0, 1, 1, 2, 2], 0),  # two publishers that started together
        ([500, 0, 501, 2, 502, 3], 1),
        ([2**64 - 1, 0, 1], 0),
    ],
)
def test_numbers(numbers: list[int], lost: int) -> None:
    found = Numbers()
    for number in numbers:
        found.add(number)
    assert found.lost == lost


def test_numbers_from_many_sources_are_bounded() -> None:
    found = Numbers()
    for number in range(1000):
        found.add(5000 * number, f"s{number % 40}")
        found.add(5000 * number)
    assert found.lost == 0


def test_a_survey() -> None:
    points = np.array([[1, 0, 0], [0, 2, 0], [0, 2, 0], [0, 0, 0], [np.nan, 0, 0], [100.0, 0, 0], [1e300, 0, 0]])
    found = survey(points, 0.1)
    assert (found.points, found.returns, found.equal) == (7, 5, 0)
    found = survey(np.concatenate([points, np.tile([0.0, 0.0, 0.05], (300, 1))]), 0.1)
    assert (found.points, found.returns, found.equal, found.equal_at) == (307, 305, 300, (0.0, 0.0, 0.05))
    found = survey(points, 0.1)
    assert [found.tiles(reach) for reach in (0.5, 1.0, 50.0, 200.0, np.inf)] == [0, 1, 1, 2, 3]
    assert survey(np.zeros((3, 3)), 0.1).returns == 0
    assert survey(np.zeros((0, 3)), 0.1).points == 0


@examples(60)
@given(SEEDS, st.floats(0.01, 1.0), st.integers(1, 500))
def test_tiles_of_a_survey(seed: int, cell: float, number: int) -> None:
    points = np.random.default_rng(seed).uniform(-50.0, 50.0, (number, 3))
    found = survey(points, cell)
    reach = float(np.linalg.norm(points, axis=1).max()) / 2.0
    for limit in (reach, 1e3):
        near = points[np.linalg.norm(points, axis=1) <= limit]
        tiles = {(int(x), int(y)) for x, y in np.floor(near[:, :2] / (64 * cell))}
        assert abs(found.tiles(limit) - len(tiles)) <= 1, "but for rounding at the limit"


def status(clouds: CloudCounts, points: PointCounts, refused: int = 0, **more: object) -> MapStatus:
    return MapStatus.model_construct(
        instance="a", clouds=clouds, points=points, poses=PoseCounts(), refused={Refusal.UNSET_STAMP: refused}, **more
    )


def test_what_the_service_made_of_it() -> None:
    before = status(CloudCounts(accepted=100), PointCounts(accepted=1000), problems={})
    fine = status(CloudCounts(accepted=130), PointCounts(accepted=9000), problems={})
    assert judge_service(before, fine) == []
    none = status(
        CloudCounts(accepted=101, rejected={CloudReason.NO_POSE: 29}), PointCounts(accepted=1000), 7, problems={}
    )
    assert [(finding.verdict, finding.text) for finding in judge_service(before, none)] == [
        ("wrong", "rejected 29 of 30 clouds meanwhile: no_pose 29"),
        ("note", "refused 7 messages meanwhile: unset_stamp 7"),
    ]
    points = PointCounts(accepted=1000, rejected={PointReason.UNCERTAIN: 3000})
    uncertain = status(CloudCounts(accepted=130), points, problems={"robot r1": "all is lost; do this"})
    assert [(finding.area, finding.text) for finding in judge_service(before, uncertain)] == [
        ("service", "all is lost; do this"),
        ("service", "rejected 3,000 of 3,000 points meanwhile: uncertain 3,000"),
    ]
    assert [finding.text for finding in judge_service(before, uncertain, {"robot r1"})] == [
        "rejected 3,000 of 3,000 points meanwhile: uncertain 3,000"
    ], "what was told is not told again"


def test_tables_quote_what_must_be_quoted() -> None:
    assert table(("sensors", "os.lidar"), {"time_offset": -37.0}) == '[sensors."os.lidar"]\ntime_offset = -37.0'
    assert table(("robots", 'a "b"', "sensors", "/x"), {"time_field": "none", "box": (0.0, 1)}) == (
        '[robots."a \\"b\\"".sensors."/x"]\ntime_field = "none"\nbox = [0.0, 1]'
    )
