"""What becomes of a cloud: every rule of the contract ends in its reason, counted in the status and kept in the log."""

import signal
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest
from processes import GROUND, LEVEL, T0, Feed, Service, events_in, running

from roughmap_schemas import IntegrationEvent, encode_cloud

S = 10**9

Running = tuple[Service, Feed]


@pytest.fixture(scope="module")
def hasty(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """Clouds wait a short while for their poses."""
    settings = {"input": {"max_wait": 0.3}, "map": {"max_new_tiles": 50, "max_tiles": 400}}
    with running(tmp_path_factory.mktemp("hasty"), **settings) as both:
        yield both


@pytest.fixture(scope="module")
def patient(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """Clouds wait for longer than the tests take, in an inbox that a few of them fill."""
    with running(
        tmp_path_factory.mktemp("patient"),
        input={"max_wait": 600.0, "queue_limit": "60KiB", "max_message": "60KiB"},
        sensors={"lidar": {"range_sigma": 0.01}, "second": {"range_sigma": 0.01}},
    ) as both:
        yield both


def drive(feed: Feed, robot: str, seconds: Iterable[float], speed: float = 0.0) -> None:
    """Poses at these seconds after T0, along x. After a gap it takes three until they are believed."""
    for second in seconds:
        feed.pose(robot, T0 + round(second * S), (speed * second, 0.0, 1.0))


def rejected(both: Running, number: int, reason: str, **told: object) -> IntegrationEvent:
    """The cloud ended for that reason: published, in the log, counted, and the map is as it was."""
    service, feed = both
    event = feed.decided(number)
    assert (event.outcome, event.accepted) == (reason, 0)
    status = feed.settle()
    logged = events_in(service.log)
    assert logged.count(event) == 1
    integrations = [e for e in logged if isinstance(e, IntegrationEvent)]
    counted = sum(e.outcome == reason for e in integrations)
    assert status.clouds.rejected[reason] == counted  # type: ignore[index]
    before = [e.sequence for e in integrations[: integrations.index(event)]]
    assert event.sequence == max(before, default=0), "it made no new version of the map"
    return event


def test_poses_on_both_sides(hasty: Running) -> None:
    _, feed = hasty
    drive(feed, "good", [0.0, 0.2, 0.4])
    event = feed.decided(feed.cloud("good", T0 + 3 * S // 10))
    assert (event.outcome, event.accepted) == ("integrated", len(GROUND))
    assert len(event.poses) == 2, "the event names the poses that were used, and no others"


def test_one_pose_of_the_same_stamp(hasty: Running) -> None:
    """An exact stamp needs no second pose."""
    _, feed = hasty
    drive(feed, "exact", [0.0])
    event = feed.decided(feed.cloud("exact", T0))
    assert (event.outcome, len(event.poses)) == ("integrated", 1)


def test_poses_too_far_apart(hasty: Running) -> None:
    _, feed = hasty
    drive(feed, "gap", [0.0, 0.6, 0.7, 0.8])
    rejected(hasty, feed.cloud("gap", T0 + 3 * S // 10), "pose_gap")


def test_a_gap_beside_the_span_does_no_harm(hasty: Running) -> None:
    _, feed = hasty
    drive(feed, "beside", [0.0, 0.6, 0.65, 0.8])
    assert feed.decided(feed.cloud("beside", T0 + 7 * S // 10)).outcome == "integrated"


@pytest.mark.parametrize("way", ["speed", "turn"])
def test_poses_that_jump(hasty: Running, way: str) -> None:
    """From standing, half a metre or half a turn in 0.1 s. Before and behind the leap poses hold."""
    _, feed = hasty
    after = ((0.5, 0.0, 1.0), LEVEL) if way == "speed" else ((0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 0.0))
    jumps = feed.settle().jumps.get(way, 0)
    drive(feed, way, [0.0, 0.1, 0.2])
    for tenth in (3, 4):
        feed.pose(way, T0 + tenth * S // 10, *after)
    assert feed.decided(feed.cloud(way, T0 + 15 * S // 100)).outcome == "integrated"
    rejected(hasty, feed.cloud(way, T0 + 25 * S // 100), "pose_jump")
    assert feed.decided(feed.cloud(way, T0 + 35 * S // 100)).outcome == "integrated"
    assert feed.settle().jumps[way] == jumps + 1


@pytest.mark.parametrize("seconds", [[], [0.0], [0.9]], ids=["none", "only before", "only after"])
def test_poses_that_do_not_come(hasty: Running, seconds: list[float]) -> None:
    _, feed = hasty
    robot = f"lost{len(seconds)}{''.join(map(str, seconds))}"
    drive(feed, robot, seconds)
    rejected(hasty, feed.cloud(robot, T0 + S // 2), "no_pose")


def test_times_of_the_points_count(hasty: Running) -> None:
    """The poses bracket the cloud's stamp, but not its last point."""
    _, feed = hasty
    drive(feed, "sweep", [0.0, 0.2])
    times = np.array([0, S // 10, S // 5, S // 4])
    rejected(hasty, feed.cloud("sweep", T0 + S // 10, offsets_ns=times), "no_pose")


def test_older_than_the_poses(hasty: Running) -> None:
    _, feed = hasty
    drive(feed, "late", [half / 2 for half in range(41)])
    rejected(hasty, feed.cloud("late", T0 + 9 * S), "late")


def test_a_cloud_that_has_its_poses_is_not_late_for_the_services_slowness(tmp_path: Path) -> None:
    """Twenty seconds of a drive lie before a service that stood still: none of it is lost to the ten that it keeps."""
    with running(tmp_path) as (service, feed):
        service.process.send_signal(signal.SIGSTOP)
        for tenth in range(200):
            drive(feed, "quick", [tenth / 10, tenth / 10 + 0.05])
            feed.put("points", "quick", encode_cloud(GROUND, T0 + tenth * S // 10 + S // 50, "lidar"))
        service.process.send_signal(signal.SIGCONT)
        outcomes = {event.outcome for event in feed.wait_integrations(200)}
        assert outcomes == {"integrated"}


def test_too_many_new_tiles(hasty: Running) -> None:
    _, feed = hasty
    tiles = np.arange(51)[:, None] * [6.4, 0.0, 0.0] + [0.05, 700.05, 0.0]
    extent = feed.client.status().extent
    rejected(hasty, feed.cloud("wide", T0, tiles, "map"), "too_many_tiles")
    assert feed.client.status().extent == extent
    assert feed.decided(feed.cloud("wide", T0, tiles[:50], "map")).accepted == 50


def test_too_many_tiles_in_all(hasty: Running) -> None:
    _, feed = hasty
    outcomes = []
    for row in range(9):
        tiles = np.arange(50)[:, None] * [6.4, 0.0, 0.0] + [0.05, -6.4 * row - 900.0, 0.0]
        outcomes.append(number := feed.cloud("many", T0 + row, tiles, "map"))
        if feed.decided(number).outcome != "integrated":
            break
    rejected(hasty, outcomes[-1], "too_many_tiles")
    tiles_there = feed.client.status().tiles.resident
    assert 350 < tiles_there <= 400


@pytest.mark.parametrize("count", [0, 3])
def test_no_point_of_use(hasty: Running, count: int) -> None:
    _, feed = hasty
    drive(feed, f"empty{count}", [0.0])
    points = np.array([[np.nan, 0.0, 0.0], [0.0, 0.0, 0.0], [np.inf, 1.0, 1.0]])[:count]
    event = rejected(hasty, feed.cloud(f"empty{count}", T0, points), "empty")
    assert {str(k): n for k, n in event.rejected.items()} == ({"not_finite": 2, "no_return": 1} if count else {})


def test_in_order_within_a_sensor_and_free_between_sensors_and_robots(patient: Running) -> None:
    """The first cloud waits for a pose, so the second of its sensor waits too; another sensor's or robot's does not."""
    _, feed = patient
    drive(feed, "a", [0.0, 0.2])
    first, second = feed.cloud("a", T0 + 3 * S // 10), feed.cloud("a", T0 + S // 10)
    beside = feed.cloud("a", T0 + S // 10, frame="second")
    drive(feed, "b", [0.0])
    other = feed.cloud("b", T0)
    feed.decided(beside)
    feed.decided(other)
    assert feed.settle().clouds.waiting == 2
    drive(feed, "a", [0.4, 0.5, 0.6])  # the second cloud fell back: poses show that the robot's clock did not
    feed.decided(second)
    decided = [e.input for e in feed.wait_integrations(4)]
    assert [n for n in decided if n in (first, second, beside, other)] == [beside, other, first, second]


def bulky(stamp_ns: int, size: int) -> bytes:
    """A cloud of about that many bytes."""
    points = np.tile(np.float32(GROUND), (size // 12 // len(GROUND), 1))
    points[:, 2] += np.linspace(0.0, 1e-3, len(points), dtype=np.float32)  # hundreds of equal points are no returns
    return encode_cloud(points, stamp_ns, "lidar")


def test_a_full_inbox_drops_the_oldest_published_cloud_of_who_holds_most(patient: Running) -> None:
    service, feed = patient
    first = feed.settle().input + 1
    for robot, stamp, size in (("big", 1, 15_000), ("small", 2, 20_000), ("big", 3, 15_000), ("third", 4, 15_000)):
        feed.put("points", robot, bulky(T0 + stamp, size))
        feed.settle()  # one at a time: several at once could fill the queue before the inbox
    feed.decided(first)
    status = feed.client.status()  # at once: it counts as overloaded for 2 s
    assert (status.clouds.waiting, status.health) == (3, "overloaded")
    rejected(patient, first, "overload")
    assert not status.refused
    for robot in ("big", "small", "third"):
        drive(feed, robot, [0.0, 0.1])
    assert {feed.decided(first + n).outcome for n in (1, 2, 3)} == {"integrated"}
    assert feed.settle().clouds.waiting == 0
    assert service.process.poll() is None


def test_an_ingested_cloud_is_never_dropped_but_refused_before_the_log(patient: Running) -> None:
    _, feed = patient
    kept = [feed.ingest("points", "sure", bulky(T0 + n, 25_000)).input for n in (1, 2)]
    before = feed.settle()
    assert feed.refused("points", "sure", bulky(T0 + 3, 25_000)) == "busy"
    after = feed.settle()
    assert after.refused["busy"] == before.refused.get("busy", 0) + 1  # type: ignore[call-overload, index]
    assert after.input == before.input, "what is refused gets no number"
    feed.put("points", "loud", bulky(T0, 25_000))
    rejected(patient, after.input + 1, "overload")
    drive(feed, "sure", [0.0, 0.1])
    assert [feed.decided(number).outcome for number in kept] == ["integrated", "integrated"]


def test_a_clock_that_went_back(patient: Running) -> None:
    """It takes three messages; what waited since before is rejected, and the robot maps again."""
    _, feed = patient
    drive(feed, "back", [half / 2 for half in range(41)])
    waiting = feed.cloud("back", T0 + 30 * S)
    drive(feed, "back", [-100.0, -99.9])
    assert feed.settle().clouds.waiting == 1
    drive(feed, "back", [-99.8])
    rejected(patient, waiting, "clock_reset")
    assert feed.decided(feed.cloud("back", T0 - 99_850_000_000)).outcome == "integrated"


def test_a_sensor_whose_clock_went_back_alone(hasty: Running) -> None:
    """While the robot's poses go on: its clouds are refused, and nothing is put where the robot was then."""
    _, feed = hasty
    drive(feed, "alone", [tenth / 10 for tenth in range(31)])
    for tenth in (28, 29):
        assert feed.decided(feed.cloud("alone", T0 + tenth * S // 10)).outcome == "integrated"
    for n in range(3):
        drive(feed, "alone", [3.1 + 0.4 * n + tenth / 10 for tenth in range(4)])
        number = feed.cloud("alone", T0 + S // 2 + n * S // 10)
    rejected(hasty, number, "clock_offset")
