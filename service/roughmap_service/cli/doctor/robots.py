"""Judges what each robot publishes: whether it can become a map."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from roughmap_schemas.config import Config
from roughmap_schemas.kinds import Kind
from roughmap_service.cli.doctor.clocks import judge_machine_clock, judge_sensor_clock
from roughmap_service.cli.doctor.clouds import judge_frame, judge_mounting, judge_points
from roughmap_service.cli.doctor.covariances import judge_covariances
from roughmap_service.cli.doctor.findings import Finding, Verdict
from roughmap_service.cli.doctor.heard import Heard, Robot, Tally, rate, times
from roughmap_service.cli.doctor.poses import judge_frames, judge_poses
from roughmap_service.cli.doctor.stamps import Course, clean, course, judge_stamps
from roughmap_service.cli.doctor.times import Times, judge_times, read_times
from roughmap_service.cli.doctor.traffic import Traffic
from roughmap_service.cli.doctor.waits import pose_waits
from roughmap_service.run.settings import NS

LOST = 0.01
"""Part of the messages that may be lost on the way."""

SILENT_S = 1.0
SILENT = 10
"""A pause longer than this many seconds, and than this many usual distances of messages, is told."""


class Odometry(NamedTuple):
    """A robot's odometry as far as clouds are compared with it: the course of its stamps, and those that rise."""

    course: Course
    rising: list[Heard]


def judge(traffic: Traffic, config: Config, seconds: float, *, mounted: bool = False) -> list[Finding]:
    """Return the findings on the traffic of the last ``seconds``; ``mounted``: a service knows all mountings."""
    robots = traffic.robots
    ended_ns = traffic.ended_ns
    findings = [one for name in sorted(robots) for one in _robot(name, robots, config, ended_ns, mounted=mounted)]
    silent = sorted(set(config.input.robots) - set(robots))
    if silent and robots:
        text = f"nothing from {', '.join(silent)} (input.robots)"
        findings.append(Finding("robots", "note", text, "check that they are on"))
    frames = {frame for robot in robots.values() for frame in robot.sensors}
    unheard = sorted(set(config.sensors) - frames)
    if not robots and not config.ros2.robots:  # of their topics, ros2 tells
        keys = config.keys["points"].replace("{robot}", "*")
        remedy = "start the robots; they must connect to this service's zenoh.listen, or it to them (zenoh.connect)"
        text = f"no messages on {keys} or its sibling keys within {seconds:g} s"
        findings.append(Finding("robots", "wrong", text, remedy))
    elif robots and unheard:
        text = f"no cloud of sensor {', '.join(unheard)} within {seconds:g} s"
        findings.append(Finding("sensors", "note", text, "check that it is on and that its clouds have this frame_id"))
    if traffic.missed:
        text = f"{traffic.missed} messages came faster than doctor could read them, and are not judged"
        findings.append(Finding("robots", "note", text, "run doctor on another machine, or with a shorter --seconds"))
    return findings


def _robot(name: str, robots: dict[str, Robot], config: Config, ended_ns: int, *, mounted: bool) -> list[Finding]:
    robot = robots[name]
    findings: list[Finding] = []
    if config.input.robots and name not in config.input.robots:
        findings.append(Finding(name, "wrong", "is not in input.robots: all its messages are refused", "add it there"))
    for kind, what in ((Kind.POINTS, "clouds"), (Kind.ODOMETRY, "odometry"), (Kind.TRANSFORM, "transforms")):
        findings += _readable(name, what, robot.tallies[kind])
    heard, transforms = list(robot.poses), list(robot.transforms)
    poses = times(heard)
    odometry = Odometry(followed := course(poses), clean(poses, followed))
    placed_only = set(robot.sensors) <= {config.map.frame_id}
    findings += judge_frames(name, heard, transforms, config)
    if heard:
        findings += judge_stamps(name, "poses", poses, poses=True)
        findings += judge_poses(name, heard, odometry.course.rows, config)
        findings += judge_covariances(name, heard, _ranges(robot), config)
    elif robot.sensors and not placed_only:
        remedy = f"publish the localisation's poses on {config.keys['odometry'].replace('{robot}', name)}"
        if name in config.ros2.robots:
            remedy = "its poses are made of ROS topics: see ros2 above"
        findings.append(Finding(name, "wrong", "no odometry: its clouds can't be placed", remedy))
    for frame in sorted(robot.sensors):
        findings += _sensor(name, frame, robots, odometry, config, ended_ns, mounted=mounted)
    if odometry.rising or robot.sensors:
        findings += judge_machine_clock(name, odometry.rising)
    findings += _numbers(name, robot, numbered=name not in config.ros2.robots)
    return findings


def _sensor(
    name: str,
    frame: str,
    robots: dict[str, Robot],
    odometry: Odometry,
    config: Config,
    ended_ns: int,
    *,
    mounted: bool,
) -> list[Finding]:
    sensor = robots[name].sensors[frame]
    heard = times(sensor.clouds)
    each = sum(cloud.points for cloud in sensor.clouds) / len(sensor.clouds)
    text = f"clouds at {rate(heard):.1f} Hz, {each:,.0f} points each, in {frame!r}"
    lead = [one for one in robots[name].transforms if one.child == frame and one.parent != config.map.frame_id]
    mounting = lead[-1] if lead else None
    findings = [Finding(name, "ok", text), *judge_frame(name, frame, config, mounting)]
    if frame == config.map.frame_id:
        return findings
    names, settings = _table(name, frame, robots, config), config.sensor(name, frame)
    findings += judge_mounting(name, frame, config, mounting, mounted=mounted)
    findings += judge_stamps(name, f"clouds in {frame!r}", heard, poses=False)
    samples = list(sensor.samples)
    found = read_times(samples, settings)
    if found is not None:
        findings += judge_times(name, frame, samples, found, settings, names)
    findings += judge_points(name, frame, sensor, config, names, mounting)
    if settings is not None:
        findings += _beside_odometry(name, frame, heard, found, odometry, config, ended_ns, settings.time_offset, names)
    return findings


def _beside_odometry(
    name: str,
    frame: str,
    heard: Sequence[Heard],
    found: Times | None,
    odometry: Odometry,
    config: Config,
    ended_ns: int,
    time_offset: float,
    table_names: tuple[str, ...],
) -> list[Finding]:
    """Compare a sensor's clouds with the odometry of its robot, by the times of their last points."""
    stamps = course(heard)
    if not odometry.rising or not stamps.rows or stamps.is_frozen or odometry.course.is_frozen:
        return []
    last_ns = round(time_offset * NS) + (0 if found is None else found.last_ns)
    ends = [Heard(cloud.arrival_ns, cloud.stamp_ns + last_ns) for cloud in clean(heard, stamps)]
    stepped = bool(stamps.steps or odometry.course.steps)
    findings = judge_sensor_clock(
        name, frame, ends, odometry.rising, table_names=table_names, time_offset=time_offset, stepped=stepped
    )
    if not stepped and not any(finding.verdict == "wrong" for finding in findings):
        findings += _waits(name, frame, ends, odometry.rising, config, ended_ns)
        findings += _rates(name, frame, ends, odometry.rising)
    return findings


def _table(name: str, frame: str, robots: dict[str, Robot], config: Config) -> tuple[str, ...]:
    """Return the name of the sensor's table, in parts: the robot's own one if it has that or others share the frame."""
    own = config.robots.get(name)
    others = any(frame in robot.sensors for other, robot in robots.items() if other != name)
    if (own is not None and frame in own.sensors) or (others and frame in config.sensors):
        return "robots", name, "sensors", frame
    return "sensors", frame


def _readable(robot: str, what: str, tally: Tally) -> list[Finding]:
    if not tally.faults:
        return []
    fault, number = tally.faults.most_common(1)[0]
    text = f"{tally.faults.total()} of {tally.number} {what} can't be read; {number}: {fault}"
    return [Finding(robot, "wrong", text, "correct the publisher: README.md shows the expected messages")]


def _ranges(robot: Robot) -> tuple[float, float, float] | None:
    """Return the distances in m that 10, 50 and 90 % of the points of a usual cloud don't reach."""
    surveys = [one.ranges for sensor in robot.sensors.values() for one in sensor.surveys if one.returns]
    if not surveys:
        return None
    near, middle, far, _ = np.median(np.array(surveys), axis=0)
    return float(near), float(middle), float(far)


def _waits(
    robot: str, frame: str, clouds: Sequence[Heard], poses: Sequence[Heard], config: Config, ended_ns: int
) -> list[Finding]:
    """Judge how long clouds wait for the poses around them."""
    waits, without = pose_waits(clouds, poses, ended_ns)
    limit = config.input.max_wait
    late = sum(wait > limit for wait in waits)
    number = len(waits) + without
    if without or late > LOST * number:
        text = f"{without + late} of {number} clouds in {frame!r} had no pose within input.max_wait = {limit:g} s"
        remedy = "make the localisation faster, or raise input.max_wait (and input.queue_limit)"
        return [Finding(robot, "wrong", text, remedy)]
    if waits:
        text = f"poses follow clouds in {frame!r} within {max(waits):.2f} s (input.max_wait {limit:g} s)"
        return [Finding(robot, "ok", text)]
    return []


def _rates(robot: str, frame: str, clouds: Sequence[Heard], poses: Sequence[Heard]) -> list[Finding]:
    """Compare the rates of clouds and odometry: what happens between two poses is not seen."""
    scans, odometry = rate(clouds), rate(poses)
    if not 0.0 < odometry < scans:
        return []
    text = f"odometry at {odometry:.1f} Hz is slower than clouds in {frame!r} at {scans:.1f} Hz"
    return [Finding(robot, "note", text, "publish poses more often: between two poses, a straight motion is assumed")]


def _numbers(name: str, robot: Robot, *, numbered: bool) -> list[Finding]:
    """Judge messages that were lost on the way, and pauses; ``numbered``: its publisher can number its messages."""
    findings = []
    for kind, what in ((Kind.POINTS, "clouds"), (Kind.ODOMETRY, "poses")):
        tally = robot.tallies[kind]
        if tally.numbers.lost:
            sent = tally.number + tally.numbers.lost
            verdict: Verdict = "wrong" if tally.numbers.lost > LOST * sent else "note"
            text = f"{tally.numbers.lost} of {sent} {what} were lost on the way, by their message_seq"
            remedy = "publish with CongestionControl.BLOCK, or with less data than the link carries"
            findings.append(Finding(name, verdict, text, remedy))
    clouds = robot.tallies[Kind.POINTS]
    if numbered and clouds.number and clouds.unnumbered == clouds.number:
        text = "clouds have no message_seq (8-byte attachment): lost clouds can't be counted"
        remedy = "attach a number that rises by one, 8 bytes little-endian; this is optional"
        findings.append(Finding(name, "note", text, remedy))
    streams = {"poses": times(robot.poses)}
    streams |= {f"clouds in {frame!r}": times(sensor.clouds) for frame, sensor in robot.sensors.items()}
    for what, messages in streams.items():
        findings += _pause(name, what, messages)
    return findings


def _pause(robot: str, what: str, messages: Sequence[Heard]) -> list[Finding]:
    gaps = np.diff(np.array([message.arrival_ns for message in messages], np.int64)) / NS
    if not len(gaps) or gaps.max() <= max(SILENT_S, SILENT * float(np.median(gaps))):
        return []
    text = f"no {what} came for {gaps.max():.1f} s meanwhile"
    return [Finding(robot, "note", text, "look at the link and the publisher")]
