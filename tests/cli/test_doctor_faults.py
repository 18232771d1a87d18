"""What `roughmap doctor` says of robots' traffic: faults, advice that mends them, nothing wrong of healthy robots."""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from doctor_faults import FAULTS, TOGETHER, stamped
from doctor_traffic import (
    LEVEL,
    NOW,
    SENSORS,
    Drive,
    findings,
    heard_transform,
    message,
    pasted,
)
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap_schemas import encode_cloud, encode_odometry
from roughmap_schemas.kinds import Kind
from roughmap_service.cli.doctor.findings import Finding
from roughmap_service.cli.doctor.traffic import Message

CONFIDENCE = (
    "the poses' heights have a sigma of 0.01 m; their errors last for 5 s (pose_error_time): "
    "the map's confidence is only as good as these two"
)


def not_well(found: list[Finding]) -> list[tuple[str, str]]:
    """Verdict and words of all that is not well."""
    return [(finding.verdict, finding.text) for finding in found if finding.verdict != "ok"]


@cache
def messages_of(name: str) -> list[Message]:
    """The messages of a drive with a fault, made once."""
    return FAULTS[name].drive.messages()


@cache
def findings_of(name: str) -> list[Finding]:
    """What is said of them, judged once."""
    return findings(messages_of(name), FAULTS[name].settings)


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_is_named(name: str) -> None:
    fault = FAULTS[name]
    told = not_well(findings_of(name))
    assert any(verdict == fault.verdict and text.startswith(fault.words) for verdict, text in told), told
    others = [text for _, text in told if not text.startswith(fault.words)]
    expected = TOGETHER.get(name, [])
    assert [text for text in others if not any(text.startswith(one) for one in expected)] == [], (
        "one cause, one finding"
    )


@pytest.mark.parametrize("name", FAULTS)
def test_all_that_is_not_well_has_a_remedy_and_pasted_settings_mend_it(name: str) -> None:
    fault = FAULTS[name]
    messages = messages_of(name)
    for finding in findings_of(name):
        assert finding.verdict == "ok" or finding.remedy, finding
        assert finding.remedy.endswith(":") == bool(finding.settings), finding
        if finding.settings:
            again = findings(messages, pasted(fault.settings, finding.settings))
            assert [text for _, text in not_well(again) if text[:20] == finding.text[:20]] == [], finding.settings


def test_each_fault_is_found_within_three_seconds() -> None:
    """The trials listen for so long; those that need a comparison over time have until the default's end."""
    slow = {
        "the robot's clock",
        "the sensor's clock",
        "clouds that come later",
        "poses that leap",
        "poses that turn",
        "dead",
    }
    for name, (_, verdict, words, settings) in FAULTS.items():
        if not any(name.startswith(one) for one in slow):
            told = not_well(findings(messages_of(name), settings, seconds=3.0))
            shape = words.lstrip("0123456789, of.")[:25]  # numbers differ
            assert any(v == verdict and shape in text for v, text in told), (name, told)


def circle(speed: float, radius: float) -> Callable[[float], Any]:
    def at(t: float) -> Any:
        angle = speed * t / radius
        half = angle / 2.0
        return (radius * math.cos(angle), radius * math.sin(angle), 0.0), (0.0, 0.0, math.sin(half), math.cos(half))

    return at


@examples(60)
@given(st.data())
def test_healthy_robots_have_nothing_wrong(data: st.DataObject) -> None:
    number = st.floats(0.0, 1.0)
    speed = 12.0 * data.draw(number)
    radius = max(speed * speed / 8.0, 2.0) * (1.0 + 9.0 * data.draw(number))
    odometry_hz, scan_hz = 4.0 * 50.0 ** data.draw(number), 1.0 * 20.0 ** data.draw(number)
    pose_late, cloud_late, jitter = (most * data.draw(number) for most in (0.2, 0.25, 0.1))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    sigmas = np.array([0.1, 0.1, 0.1, 0.01, 0.01, 0.01]) * data.draw(number)
    behind = data.draw(st.sampled_from([0.0, 0.0, -20.0, 1e7]))
    late = rng.uniform(0.0, jitter, 10_000)
    noise = rng.normal(0.0, 0.003, (10_000, 3))
    drive = Drive(
        odometry_hz=odometry_hz,
        scan_hz=scan_hz,
        pose_latency=lambda n: pose_late + late[n],
        cloud_latency=lambda n: 0.1 + cloud_late + late[-n],
        motion=lambda t: (
            tuple(np.add(circle(speed, radius)(t)[0], noise[round(t * 200) % 10_000])), circle(speed, radius)(t)[1]
        ),
        covariance=lambda t: np.diag(sigmas**2),
        pose_stamps=stamped(lambda t, n: -behind),
        cloud_stamps=stamped(lambda t, n: -behind),
        sweep=min(0.0999, 0.9 / scan_hz),
    )  # fmt: skip
    seconds = data.draw(st.sampled_from([3.0, 5.0, 8.0]))
    wrong = [finding for finding in findings(drive.messages(), seconds=seconds) if finding.verdict == "wrong"]
    assert wrong == []


def test_a_robot_that_does_all_right() -> None:
    told = findings(Drive().messages())
    assert not_well(told) == []
    assert [finding.text for finding in told] == [
        "odometry at 50.0 Hz, in 'map'",
        CONFIDENCE,
        "clouds at 10.0 Hz, 400 points each, in 'lidar'",
        "points in 'lidar' have times: t (uint32) in ns from the sweep's start, over 0.0999 s",
        "poses follow clouds in 'lidar' within 0.00 s (input.max_wait 0.5 s)",
    ]


def test_two_scanners_one_by_tai() -> None:
    settings = {"sensors": {**SENSORS, "rear": SENSORS["lidar"]}}
    rear = Drive(odometry=False, cloud_frame="rear", cloud_stamps=stamped(lambda t, n: 37.0)).messages()
    messages = sorted(Drive().messages() + rear, key=lambda one: one.arrival_ns)
    told = findings(messages, settings)
    (wrong,) = (finding for finding in told if finding.verdict == "wrong")
    assert wrong.text.startswith("clouds in 'rear' are stamped 37.0 s ahead of the odometry")
    assert wrong.settings == "[sensors.rear]\ntime_offset = -37.0"
    assert not_well(findings(messages, pasted(settings, wrong.settings))) == []


def test_two_robots_with_one_frame_name_have_tables_of_their_own() -> None:
    other = Drive(robot="r2", cloud_stamps=stamped(lambda t, n: 37.0)).messages()
    messages = sorted(Drive().messages() + other, key=lambda one: one.arrival_ns)
    (wrong,) = (finding for finding in findings(messages) if finding.verdict == "wrong")
    assert (wrong.area, wrong.settings) == ("r2", "[robots.r2.sensors.lidar]\ntime_offset = -37.0")
    assert not_well(findings(messages, pasted(None, wrong.settings))) == []


def test_a_recording_at_another_speed_is_healthy() -> None:
    for speed in (0.2, 3.0, 10.0):
        drive = Drive(seconds=8.0 * speed)
        fast = [one._replace(arrival_ns=NOW + round((one.arrival_ns - NOW) / speed)) for one in drive.messages()]
        assert [text for verdict, text in not_well(findings(fast)) if verdict == "wrong"] == [], speed


def test_a_recording_with_a_gap_and_one_that_starts_over() -> None:
    old = -9e6
    gap = Drive(
        pose_stamps=stamped(lambda t, n: old + 30.0 * (t > 4)), cloud_stamps=stamped(lambda t, n: old + 30.0 * (t > 4))
    )
    assert {verdict for verdict, _ in not_well(findings(gap.messages()))} == {"note"}
    over = Drive(
        pose_stamps=stamped(lambda t, n: old - 4.0 * (t > 4)), cloud_stamps=stamped(lambda t, n: old - 4.0 * (t > 4))
    )
    assert any("went back by 4.0" in text for _, text in not_well(findings(over.messages())))


def test_seven_centimetres_in_a_millisecond_are_no_leap() -> None:
    def stumbling(t: float) -> Any:
        return (t + 0.07 * (t > 4), 0.0, 0.0), LEVEL

    assert not_well(findings(Drive(odometry_hz=1000, seconds=5, motion=stumbling).messages(), seconds=5.0)) == []


def test_frames_that_a_transform_joins() -> None:
    for stamp in (0, NOW):
        drive = Drive(frame="odom", transforms=[heard_transform(0.01, stamp)])
        assert not_well(findings(drive.messages())) == []


def test_names_that_are_expected_and_names_that_are_not() -> None:
    settings = {"input": {"robots": ["r1", "r2"]}, "sensors": {**SENSORS, "camera": {"range_sigma": 0.1}}}
    messages = Drive().messages() + Drive(robot="r3").messages()
    assert not_well(findings(messages, settings)) == [
        ("wrong", "is not in input.robots: all its messages are refused"),
        ("note", "nothing from r2 (input.robots)"),
        ("note", "no cloud of sensor camera within 8 s"),
    ]


def test_nobody() -> None:
    ((verdict, text),) = not_well(findings([]))
    assert (verdict, "no messages on robots/*/points" in text) == ("wrong", True)


def test_poses_are_needed_but_for_clouds_in_the_maps_own_frame() -> None:
    placed = Drive(robot="placed", odometry=False, cloud_frame="map").messages()
    bare = Drive(robot="bare", odometry=False).messages()
    wrong = [(finding.area, finding.text) for finding in findings(placed + bare) if finding.verdict == "wrong"]
    assert wrong == [("bare", "no odometry: its clouds can't be placed")]


def test_messages_that_cannot_be_read() -> None:
    messages = Drive().messages()
    messages.append(message(Kind.POINTS, b"\xff", 9.0 - 1.0, number=79))
    messages.append(message(Kind.ODOMETRY, messages[0].payload, 4.0, number=400, encoding="text/plain"))
    assert [text[:45] for _, text in not_well(findings(messages))] == [
        "1 of 80 clouds can't be read; 1: bad_message:",
        "1 of 401 odometry can't be read; 1: bad_encod",
    ]


def test_numbers_that_are_missing() -> None:
    messages = Drive().messages()
    bare = [one._replace(number=None) for one in messages]
    assert not_well(findings(bare)) == [
        ("note", "clouds have no message_seq (8-byte attachment): lost clouds can't be counted")
    ]
    lossy = [one for at, one in enumerate(messages) if at % 20 or one.kind is not Kind.ODOMETRY]
    ((verdict, text),) = not_well(findings(lossy))
    assert (verdict, "poses were lost on the way, by their message_seq" in text) == ("wrong", True)


def test_a_pause_is_told() -> None:
    messages = [
        one for one in Drive().messages() if not 3e9 < one.arrival_ns - NOW < 5.5e9 or one.kind is Kind.ODOMETRY
    ]
    told = [text for _, text in not_well(findings(messages))]
    assert "no clouds in 'lidar' came for 2.6 s meanwhile" in told


def hostile(names: int) -> list[Message]:
    found = []
    for n in range(names):
        found.append(message(Kind.ODOMETRY, encode_odometry(NOW, "map", (0, 0, 0), LEVEL), n * 0.01, f"r{n}"))
        found.append(message(Kind.ODOMETRY, encode_odometry(NOW + n, f"f{n}", (0, 0, 0), LEVEL), n * 0.01))
        found.append(message(Kind.POINTS, encode_cloud(np.ones((2, 3)), NOW + n, f"f{n}"), n * 0.01))
        found.append(heard_transform(n * 0.01, NOW + n, f"f{n}", f"g{n}"))
    return found


def test_names_from_outside_are_bounded() -> None:
    told = findings(hostile(300))
    areas = {finding.area for finding in told}
    assert len(areas) <= 256 + 2
    assert len([finding for finding in told if finding.area == "r1"]) < 64 * 8


def test_stamps_that_are_too_close_at_first_do_not_make_times_unclear() -> None:
    """The service is content with the first cloud, whose times have one meaning only."""
    close = Drive(cloud_stamps=lambda t, n: NOW + round((t - 0.04 * min(n, 5)) * 1e9))
    assert not [text for _, text in not_well(findings(close.messages())) if "unclear" in text]
