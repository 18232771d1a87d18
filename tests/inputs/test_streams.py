"""What is told of lost streams: for each reason, once, in one sentence whose remedy can be pasted; and its end."""

import logging
import tomllib
from collections.abc import Callable

import pytest

from roughmap_schemas import Config
from roughmap_schemas.reasons import CloudReason, PointReason, PoseReason, Refusal
from roughmap_service.host.counters import OTHERS
from roughmap_service.inputs.admission import frame_of
from roughmap_service.inputs.losses import Cause, Outcome
from roughmap_service.inputs.remedies import Figures, Subject, sensor_table, sentence, toml_key
from roughmap_service.inputs.streams import (
    MAX_PROBLEMS,
    MAX_STRANGERS,
    MAX_SUBJECTS,
    RENEWED,
    SERVICES_OWN,
    Streams,
    cloud_cause,
)

CONFIG = Config.model_validate(
    {
        "sensors": {"lidar": {"range_sigma": 0.01}, "os.lidar": {"range_sigma": 0.01}},
        "robots": {"r.2": {"sensors": {"lidar": {"range_sigma": 0.02}}}},
    }
)


SENSOR = "robot r1 sensor lidar"


class Watch:
    """Streams with a clock that the test moves, and the events of the log lines about them."""

    def __init__(self, lines: pytest.LogCaptureFixture) -> None:
        self.now = 100.0
        self.streams = Streams(CONFIG, lambda: self.now)
        self._lines = lines

    def feed(self, what: Callable[[], None], number: int = 10, period: float = 0.1) -> None:
        for _ in range(number):
            self.now += period
            what()

    def cloud(self, outcome: str = "integrated", **rejected: int) -> Callable[[], None]:
        accepted = 100 if outcome == "integrated" and not rejected else 0
        return lambda: self.streams.cloud("r1", "lidar", outcome, accepted, rejected)

    @property
    def lines(self) -> list[tuple[str, str]]:
        return [(getattr(record, "event", ""), record.getMessage()) for record in self._lines.records]

    @property
    def said(self) -> list[tuple[str, str]]:
        """What was said of problems."""
        return [line for line in self.lines if line[0] != "lost_some"]


@pytest.fixture
def watch(caplog: pytest.LogCaptureFixture) -> Watch:
    caplog.set_level(logging.INFO)
    return Watch(caplog)


def every_reason() -> list[tuple[str, str]]:
    kinds = (("cloud", CloudReason), ("point", PointReason), ("pose", PoseReason), ("refused", Refusal))
    return [(kind, str(reason)) for kind, reasons in kinds for reason in reasons if str(reason) not in SERVICES_OWN]


def lose(streams: Streams, kind: str, reason: str, robot: str = "r1", frame: str = "lidar") -> None:
    if kind == "cloud":
        streams.cloud(robot, frame, reason, 0, {})
    elif kind == "point":
        streams.cloud(robot, frame, "integrated", 2, {reason: 98}) if reason not in (
            "no_return", "not_finite", "duplicate_return"
        ) else streams.cloud(robot, frame, "empty", 0, {reason: 100})  # fmt: skip
    elif kind == "pose":
        streams.pose(robot, reason)
    else:
        streams.refused(robot, frame, reason, "what is wrong with it")


@pytest.mark.parametrize(("kind", "reason"), every_reason())
def test_every_reason_is_told_once_with_subject_and_remedy(kind: str, reason: str, watch: Watch) -> None:
    watch.feed(lambda: lose(watch.streams, kind, reason), 9)
    assert (watch.streams.problems(), watch.said) == ({}, [])
    watch.feed(lambda: lose(watch.streams, kind, reason), 40)
    ((subject, text),) = watch.streams.problems().items()
    of_robot = kind == "pose" or reason in ("bad_key", "unknown_robot")
    assert subject == ("robot r1" if of_robot else "robot r1 sensor lidar")
    assert watch.said == [("stream_lost", text)]
    assert text.startswith(f"{subject}: ")
    assert "\n" not in text
    assert "{" not in text, "a blank that was not filled"
    cause, *_, remedy = text.split("; ") if ";" in text else text.rsplit(": ", 1)
    assert remedy
    if kind == "point":
        share = 98 if "empty" not in cause and reason not in ("no_return", "not_finite", "duplicate_return") else 100
        assert f"{share} % of the points of the last 10 clouds were rejected as {reason}" in text
    else:
        assert "none of its last 10 " in text


@pytest.mark.parametrize(("kind", "reason"), every_reason())
def test_a_single_loss_is_listed_for_a_minute_and_logged_once(kind: str, reason: str, watch: Watch) -> None:
    watch.streams.pose("r1", None)
    watch.streams.cloud("r1", "lidar", "integrated", 100, {})
    for _ in range(3):
        lose(watch.streams, kind, reason)
        watch.now += 7
    (text,) = watch.streams.recent.told()
    subject = "robot r1" if kind == "pose" or reason in ("bad_key", "unknown_robot") else SENSOR
    assert text.startswith(f"{subject}: ")
    assert text.endswith(" (3 times, last 7 s ago)")
    remedy = text.removesuffix(" (3 times, last 7 s ago)").rsplit("; ")[-1].rsplit(": ")[-1]
    once = [] if kind == "refused" else ["lost_some"]  # each refusal has a line of its own
    assert [event for event, _ in watch.lines] == once
    assert all(line.startswith(f"{subject}: ") and line.endswith(remedy) for _, line in watch.lines)
    watch.now += 60
    assert (watch.streams.recent.told(), watch.streams.problems()) == ([], {})


def test_of_strangers_nothing_is_listed(watch: Watch) -> None:
    for number in range(100):
        watch.streams.refused(f"ghost{number}", "odometry", "unknown_robot", "64 robots are known already")
        watch.streams.gap(f"ghost{number}", "odometry", 3)
    assert (watch.streams.recent.told(), watch.lines) == ([], [])


def test_a_loss_that_goes_on_is_logged_once_a_minute(watch: Watch) -> None:
    for _ in range(20):  # one in five
        watch.streams.cloud("r1", "lidar", "late", 0, {})
        watch.feed(watch.cloud(), 4, 2.5)
    assert [event for event, _ in watch.lines] == ["lost_some"] * 4


def test_what_became_a_problem_is_no_longer_listed_as_lately(watch: Watch) -> None:
    watch.feed(watch.cloud("late"), 9)
    assert len(watch.streams.recent.told()) == 1
    watch.feed(watch.cloud("late"), 1)
    assert (watch.streams.recent.told(), len(watch.streams.problems())) == ([], 1)


def test_messages_lost_on_the_way_are_summed(watch: Watch) -> None:
    watch.streams.gap("r1", "odometry", 1)
    assert watch.lines == [], "nothing was taken of it yet"
    watch.streams.pose("r1", None)
    watch.now += 2
    watch.streams.gap("r1", "odometry", 1200)
    assert [event for event, _ in watch.lines] == ["gap"]
    (text,) = watch.streams.recent.told()
    assert text.startswith("robot r1: 1,201 of its odometry messages were lost on the way so far; publish with ")


@pytest.mark.parametrize(("share", "told"), [(10, False), (30, True)])
def test_many_points_lost_of_a_mapped_cloud_are_listed(share: int, told: bool, watch: Watch) -> None:
    watch.streams.cloud("r1", "lidar", "integrated", 1000 - 10 * share, {"uncertain": 10 * share})
    assert watch.streams.problems() == {}
    assert bool(watch.streams.recent.told()) == told


def test_names_forge_no_line(watch: Watch) -> None:
    frame = "x\nrobot r2: none of its poses was taken"
    watch.feed(lambda: watch.streams.refused("r1", frame, "unknown_sensor", f"frame {frame} is unknown"))
    watch.streams.happened(Subject("r1", frame), "leap", "its pose\nleapt")
    (problem,), (lately,) = watch.streams.problems().values(), watch.streams.recent.told()
    assert "\n" not in problem + lately + "".join(watch.streams.problems())


def test_equal_points_are_listed_though_the_cloud_is_mapped(watch: Watch) -> None:
    watch.streams.cloud("r1", "lidar", "integrated", 900, {"duplicate_return": 100, "no_return": 50})
    (text,) = watch.streams.recent.told()
    assert text.startswith(f"{SENSOR}: 100 of the 1,050 points of a cloud were rejected as duplicate_return")
    assert watch.streams.problems() == {}


def test_what_is_wrong_with_the_service_is_not_told_of_the_sender(watch: Watch) -> None:
    for reason in SERVICES_OWN:
        watch.feed(lambda reason=reason: watch.streams.refused("r1", "odometry", reason, ""))  # type: ignore[misc]
        watch.feed(watch.cloud(reason))
    assert (watch.streams.problems(), watch.said) == ({}, [])


def test_it_ends_after_ten_good_ones_with_a_line(watch: Watch) -> None:
    watch.feed(watch.cloud("late"))
    watch.feed(watch.cloud(), 9)
    assert watch.streams.problems()
    watch.feed(watch.cloud(), 1)
    assert watch.streams.problems() == {}
    assert watch.said[1:] == [("stream_restored", "robot r1 sensor lidar: its clouds are mapped again")]


def test_it_ends_when_the_sender_is_silent(watch: Watch) -> None:
    watch.feed(watch.cloud("late"))
    watch.now += 60.0
    assert watch.streams.problems()
    watch.now += 1.0
    assert watch.streams.problems() == {}
    assert [event for event, _ in watch.said] == ["stream_lost", "stream_silent"]
    watch.feed(watch.cloud("late"), 9)
    assert watch.streams.problems() == {}, "ten are needed again"


def test_another_reason_is_told_anew(watch: Watch) -> None:
    watch.feed(watch.cloud("late"))
    watch.feed(watch.cloud("pose_gap"))
    assert ["older than the poses" in text for _, text in watch.said] == [True, False]


def test_figures_are_looked_up_only_for_a_sentence_and_renewed(watch: Watch) -> None:
    looked = []

    def look() -> Figures:
        looked.append(watch.now)
        return Figures(f"figure {len(looked)}", f"remedy {len(looked)}")

    watch.feed(lambda: watch.streams.cloud("r1", "lidar", "late", 0, {}, look), 50)
    (text,) = watch.streams.problems().values()
    assert len(looked) == 2, "for the first one, and when they became a problem"
    assert text.endswith("; figure 2; remedy 2")
    watch.now += RENEWED
    watch.feed(lambda: watch.streams.cloud("r1", "lidar", "late", 0, {}, look), 2)
    (text,) = watch.streams.problems().values()
    assert text.endswith("; figure 3; remedy 3")
    assert len(watch.said) == 1, "the line is not repeated"


@pytest.mark.parametrize("frame", ["lidar", "os.lidar", 'a "b"\\c', "Röver\x7f\x01", "a b"])
@pytest.mark.parametrize("robot", ["r1", "r.2"])
def test_tables_can_be_pasted(robot: str, frame: str) -> None:
    table = sensor_table(CONFIG, robot, frame)
    read = tomllib.loads(f"{table}\ntime_offset = -37.0\n")
    own = robot == "r.2" and frame == "lidar"
    assert read == (
        {"robots": {robot: {"sensors": {frame: {"time_offset": -37.0}}}}}
        if own
        else {"sensors": {frame: {"time_offset": -37.0}}}
    )


def test_a_plain_name_is_not_quoted() -> None:
    assert [toml_key(name) for name in ("os1_lidar-2", "os.lidar", "")] == ["os1_lidar-2", '"os.lidar"', '""']


@pytest.mark.parametrize(
    ("accepted", "rejected", "cause"),
    [
        (10, {"range": 90}, "range"),
        (11, {"range": 89}, None),
        (0, {"range": 3, "uncertain": 40}, "uncertain"),
        (30, {"no_return": 970}, None),  # an open sky
        (2, {"no_return": 970, "range": 28}, "range"),
        (0, {"no_return": 100}, "no_return"),
        (5, {}, None),
    ],
)
def test_a_cloud_without_nearly_all_of_its_points_is_lost(
    accepted: int, rejected: dict[str, int], cause: str | None
) -> None:
    found = cloud_cause("integrated" if accepted else "empty", accepted, rejected)
    assert found == (None if cause is None else ("point", cause))


def test_clouds_without_poses_point_to_what_is_wrong_with_the_poses(watch: Watch) -> None:
    watch.feed(watch.cloud("no_pose"))
    assert "no odometry has come from the robot" in watch.said[-1][1]
    watch.feed(lambda: watch.streams.pose("r1", "frozen"))
    watch.now += RENEWED
    watch.feed(lambda: watch.streams.pose("r1", "frozen"))
    watch.feed(watch.cloud("no_pose"), 1)
    assert watch.streams.problems()["robot r1 sensor lidar"].endswith(
        "none of the robot's poses is taken; see the line of robot r1"
    )
    watch.feed(lambda: watch.streams.pose("r1", None))
    watch.now += RENEWED
    watch.feed(watch.cloud("no_pose"), 1)
    assert "its last odometry came 30 s ago" in watch.streams.problems()["robot r1 sensor lidar"]


def test_refused_messages_count_with_the_good_ones_of_their_kind(watch: Watch) -> None:
    refuse = lambda: watch.streams.refused("r1", "transform", "bad_message", "broken")  # noqa: E731
    watch.streams.transform("r1")
    watch.feed(refuse, 9)
    watch.streams.transform("r1")
    watch.feed(refuse, 9)
    assert watch.streams.problems() == {}
    watch.feed(refuse, 1)
    assert "none of its last 10 transforms was taken: broken" in watch.streams.problems()["robot r1"]
    watch.feed(lambda: watch.streams.transform("r1"))
    assert watch.streams.problems() == {}
    watch.feed(lambda: watch.streams.refused("r1", "points", "bad_encoding", "broken"))
    assert "none of its last 10 clouds was taken" in watch.streams.problems()["robot r1"]
    watch.feed(watch.cloud())
    assert watch.streams.problems() == {}
    watch.feed(lambda: watch.streams.refused(OTHERS, "points", "bad_key", "no name"))
    assert list(watch.streams.problems()) == ["robots without a valid name"]


def test_a_remark_is_told_once_per_change_and_stands_while_the_subject_sends(watch: Watch) -> None:
    for _ in range(3):
        watch.streams.remark(Subject("r1"), "two_sources", "its odometry has two sources")
    watch.streams.remark(Subject("r1"), "two_sources", "its odometry has three sources")
    watch.feed(lambda: watch.streams.pose("r1", "frozen"))
    text = watch.streams.problems()["robot r1"]
    assert text.startswith("robot r1: none of its last 10 poses was taken: all have one stamp")
    assert text.endswith("; its odometry has three sources")
    watch.now += 61.0
    assert watch.streams.problems() == {}
    watch.streams.pose("r1", None)
    assert list(watch.streams.problems()) == ["robot r1"]
    for _ in range(2):
        watch.streams.remark(Subject("r1"), "two_sources", None)
    assert watch.streams.problems() == {}
    told = [event for event, _ in watch.said if event.startswith("remark")]
    assert told == ["remark", "remark", "remark_ended"]


def test_strangers_take_no_room_from_robots_and_nothing_grows_without_bound(watch: Watch) -> None:
    for number in range(MAX_SUBJECTS):
        watch.feed(lambda n=number: watch.streams.refused(f"x{n}", "odometry", "unknown_robot", "who"), 10, 0.0)  # type: ignore[misc]
    assert len(watch.said) == MAX_STRANGERS
    for number in range(MAX_SUBJECTS):
        watch.feed(lambda n=number: watch.streams.pose(f"r{n}", "frozen"), 10, 0.0)  # type: ignore[misc]
    assert len(watch.streams._watched) == MAX_SUBJECTS
    listed = watch.streams.problems()
    assert len(listed) == MAX_PROBLEMS
    assert f"{MAX_SUBJECTS - MAX_PROBLEMS + 1} more" in listed["others"]
    long = "f" * 100_000
    watch.now += 61.0
    watch.streams.problems()
    watch.feed(lambda: watch.streams.refused("r1", long, "unknown_sensor", long))
    assert max(map(len, watch.streams.problems().values())) <= 1000
    assert max(len(subject) for subject in watch.streams.problems()) < 300


def test_frames_that_nobody_configured_do_not_crowd_out_a_robot_that_is_lost(watch: Watch) -> None:
    for number in range(MAX_STRANGERS):
        watch.feed(lambda n=number: watch.streams.refused("r1", f"f{n}", "unknown_sensor", ""), 10, 0.0)  # type: ignore[misc]
    watch.feed(lambda: watch.streams.pose("r2", "frozen"), 10, 0.0)
    listed = list(watch.streams.problems())
    assert (listed[0], len(listed)) == ("robot r2", MAX_PROBLEMS)


def test_the_frame_of_a_broken_cloud_is_found_where_there_is_one() -> None:
    assert frame_of(b"\x12\x05lidar\x32\xff\xff\xff\x0f") == "lidar"
    assert frame_of(b"\x12\x7flidar") == ""
    assert frame_of(b"\x12\x02\xff\xfe") == "\ufffd\ufffd"
    assert frame_of(b"no protobuf at all") == ""
    assert frame_of(b"") == ""
    assert len(frame_of(b"\x12\x80\x80\x04" + b"x" * 65536)) <= 500


def test_a_robot_on_ros_topics_without_poses_is_sent_to_doctor() -> None:
    config = Config.model_validate({"ros2": {"robots": {"rover": {"clouds": ["/points"]}}}})
    cause = Cause("cloud", "no_pose")
    for robot, remedy in (
        ("rover", "`roughmap doctor` names the ROS topic"),
        ("r2", "publish its odometry on robots/r2"),
    ):
        text = sentence(config, Subject(robot, "lidar"), cause, [Outcome(0.0, cause)], Figures())
        assert remedy in text
