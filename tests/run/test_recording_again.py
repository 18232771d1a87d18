"""After a reset the same recording maps again: the same bytes, the same outcomes, the same map."""

from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from service_tools import LoggedRun, cloud, config, odometry, transform

from roughmap_schemas import CloudReason, IntegrationEvent, decode_event
from roughmap_schemas.kinds import Kind
from roughmap_service.engine.recovery import recover
from roughmap_service.offline.replay import replay
from roughmap_service.run.duplicates import Duplicates
from roughmap_service.run.settings import Settings

Bag = list[tuple[Kind, bytes, float]]
"""Messages with the times in s at which they were made."""

HISTORY = 10.0
"""`input.pose_history` in s."""


def bag(seconds: float, *, frame: str = "map", frames: Sequence[str] = ("lidar",)) -> Bag:
    """A robot at 1 m/s: poses at 10 Hz, and clouds at 2 Hz of each sensor."""
    made: Bag = []
    if frame != "map":
        made.append((Kind.TRANSFORM, transform(0.0, 0.25, frame), -1.0))
    for k in range(round(seconds * 10) + 1):
        made.append((Kind.ODOMETRY, odometry(0.1 * k, 0.1 * k, frame), 0.1 * k))
        if k % 5 == 1:
            made += [(Kind.POINTS, cloud(0.1 * k - 0.03, 0.01 * n, of), 0.1 * k) for n, of in enumerate(frames)]
    return made


def poses_first(made: Bag) -> Bag:
    return sorted(made, key=lambda message: message[0] is Kind.POINTS)


def clouds_first(made: Bag) -> Bag:
    return sorted(made, key=lambda message: message[0] is not Kind.POINTS)


def interleaved(made: Bag) -> Bag:
    return made


def late_clouds(made: Bag) -> Bag:
    return sorted(made, key=lambda message: message[2] + (0.7 if message[0] is Kind.POINTS else 0.0))


def play(run: LoggedRun, made: Bag) -> None:
    """Feed a recording flat out; in the end the waits are over."""
    for kind, payload, _ in made:
        run.put(kind, payload)
        run.decide()
    run.decide(1e9)


def outcomes(run: LoggedRun, epoch: int) -> list[str]:
    events = [event for event in map(decode_event, run.published) if isinstance(event, IntegrationEvent)]
    return [str(event.outcome) for event in sorted(events, key=lambda event: event.input) if event.epoch == epoch]


SETTINGS = config(
    input={"pose_history": HISTORY}, sensors={"lidar": {"range_sigma": 0.01}, "second": {"range_sigma": 0.02}}
)
ORDERS: list[Callable[[Bag], Bag]] = [interleaved, poses_first, clouds_first, late_clouds]


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("seconds", [0.0, 0.4, 3.0, 9.9, 25.0])
@pytest.mark.parametrize("frame", ["map", "odom"])
def test_the_same_bytes_map_again(seconds: float, order: Callable[[Bag], Bag], frame: str, tmp_path: Path) -> None:
    """Whether the recording is shorter or longer than the poses that are kept, and whatever comes first."""
    made = order(bag(seconds, frame=frame))
    digests, sequences = [], []
    with LoggedRun(tmp_path / "log", SETTINGS) as run:
        for _ in range(3):
            begun = run.run.map.sequence
            play(run, made)
            digests.append(run.run.map.digest())
            sequences.append(run.run.map.sequence - begun)
            run.checkpoint()
            run.reset()
        run.checkpoint()
        first, second, third = (outcomes(run, epoch) for epoch in (1, 2, 3))
    clouds = sum(kind is Kind.POINTS for kind, _, _ in made)
    assert len(first) == clouds
    if order is not poses_first or seconds < HISTORY:  # else the poses of the first clouds are gone, each time
        assert first == ["integrated"] * clouds
    assert first == second == third
    assert len(set(digests)) == len(set(sequences)) == 1
    assert replay([tmp_path / "log"]).difference is None


def test_a_recording_of_one_pose(tmp_path: Path) -> None:
    """Its stamp is the newest there is; a cloud of that very moment needs no other."""
    made = [(Kind.ODOMETRY, odometry(1.0), 1.0), (Kind.POINTS, cloud(1.0), 1.0)]
    with LoggedRun(tmp_path / "log", SETTINGS) as run:
        for epoch in (1, 2, 3):
            play(run, made)
            assert outcomes(run, epoch) == ["integrated"]
            run.reset()


def test_without_a_reset_the_same_bytes_count_once(tmp_path: Path) -> None:
    made = bag(3.0)
    with LoggedRun(tmp_path / "log", SETTINGS) as run:
        play(run, made)
        before = run.run.map.digest(), run.run.input
        play(run, made)
        assert (run.run.map.digest(), run.run.input) == before


def test_a_reset_within_a_recording(tmp_path: Path) -> None:
    """What waited then is of the time before; what is sent again from the beginning maps whole."""
    made = bag(3.0)
    with LoggedRun(tmp_path / "whole", SETTINGS) as whole:
        play(whole, made)
    with LoggedRun(tmp_path / "log", SETTINGS) as run:
        for kind, payload, _ in made[: len(made) // 2]:
            run.put(kind, payload)
            run.decide()
        waiting = run.put(Kind.POINTS, cloud(2.9, 0.5))
        run.reset()
        play(run, made)
        run.checkpoint()
        events = [e for e in map(decode_event, run.published) if isinstance(e, IntegrationEvent)]
    assert [e.outcome for e in events if e.input == waiting] == [CloudReason.CLOCK_RESET]
    assert run.run.map.digest() == whole.run.map.digest()
    assert replay([tmp_path / "log"]).difference is None


def test_a_robot_that_drives_on_over_a_reset_loses_nothing(tmp_path: Path) -> None:
    made = bag(6.0)
    with LoggedRun(tmp_path / "log", SETTINGS) as run:
        for part in (made[: len(made) // 2], made[len(made) // 2 :]):
            for kind, payload, _ in part:
                run.put(kind, payload)
                run.decide()
            run.reset()
        run.decide(1e9)
        found = outcomes(run, 1) + outcomes(run, 2) + outcomes(run, 3)
    assert found == ["integrated"] * len(found)
    assert len(found) == sum(kind is Kind.POINTS for kind, _, _ in made)


def test_a_reset_then_a_restart_then_the_same_bytes(tmp_path: Path) -> None:
    """What a reset forgets stays forgotten: a start rebuilds it from the log."""
    made, logs = bag(3.0), tmp_path / "log"
    with LoggedRun(logs, SETTINGS) as run:
        play(run, made)
        digest = run.run.map.digest()
        run.reset()
        state = {name: robot.to_state() for name, robot in run.run.robots.items()}
    back = recover(SETTINGS, logs, None)
    assert {name: robot.to_state() for name, robot in back.run.robots.items()} == state
    with LoggedRun(logs, SETTINGS, recovered=back) as again:
        play(again, made)
        again.checkpoint()
    assert again.run.map.digest() == digest
    assert replay([logs]).difference is None


def test_by_the_rules_of_version_1_a_reset_forgets_nothing(tmp_path: Path) -> None:
    """A log made under them is replayed as it was: what it refused then as sent before never was in it."""
    kind, payload, _ = bag(1.0)[0]
    identity = Duplicates.identity("rover", kind, payload)
    for rules, found in ((1, 1), (2, None)):
        with LoggedRun(tmp_path / f"log{rules}", SETTINGS) as run:
            run.run.use(Settings(SETTINGS, rules=rules))
            play(run, bag(1.0))
            assert run.run.duplicates.find(identity) == 1
            run.reset()
            assert run.run.duplicates.find(identity) == found


@examples(30)
@given(st.floats(0.0, 14.0), st.lists(st.floats(0.0, 1.5), min_size=1, max_size=20), st.booleans(), st.integers(1, 3))
def test_whatever_comes_late(seconds: float, late: list[float], of_two: bool, times: int) -> None:
    """Clouds of one or two sensors, each behind its poses by another time, in any order: each epoch is like the first.

    Sensors' own clouds come in order, as a publisher sends them."""
    made = bag(seconds, frames=("lidar", "second") if of_two else ("lidar",))
    arrivals: list[tuple[float, int]] = []
    newest = 0.0
    for k, (kind, _, t) in enumerate(made):
        if kind is Kind.POINTS:
            newest = max(newest, t + late[k % len(late)])
        arrivals.append((newest if kind is Kind.POINTS else t, k))
    made = [made[k] for _, k in sorted(arrivals)]
    with TemporaryDirectory() as folder, LoggedRun(Path(folder, "log"), SETTINGS) as run:
        digests = []
        for _ in range(times + 1):
            play(run, made)
            digests.append(run.run.map.digest())
            run.reset()
        first, *others = (outcomes(run, epoch) for epoch in range(1, times + 2))
        assert set(first) <= {"integrated"}
    assert all(other == first for other in others)
    assert len(set(digests)) == 1
