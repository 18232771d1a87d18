"""Checks of what the robots publish: whether it can become a map."""

from roughmap_schemas.config import Config
from roughmap_service.cli.doctor.findings import Finding
from roughmap_service.cli.doctor.traffic import Heard, Stream, Traffic, largest_gap, pose_waits

CLOCK_S = 1.0
"""Seconds. Stamps further than this from this machine's clock come from another clock, or from a recording."""


def judge(traffic: Traffic, config: Config, seconds: float) -> list[Finding]:
    """Return the findings on the traffic of the last ``seconds``."""
    findings = [
        finding for robot, heard in sorted(traffic.robots.items()) for finding in _robot(robot, heard, traffic, config)
    ]
    silent = sorted(set(config.input.robots) - set(traffic.robots))
    if silent and traffic.robots:
        findings.append(
            Finding("robots", "note", f"nothing from {', '.join(silent)} (input.robots)", "check that they are on")
        )
    frames = {frame for heard in traffic.robots.values() for frame in heard.cloud_frames}
    unheard = sorted(set(config.sensors) - frames)
    if not traffic.robots:
        keys = config.keys["points"].replace("{robot}", "*")
        remedy = "start the robots; they must connect to this service's zenoh.listen, or it to them (zenoh.connect)"
        findings.append(
            Finding("robots", "wrong", f"no messages on {keys} or its sibling keys within {seconds:g} s", remedy)
        )
    elif unheard:
        text = f"no cloud of sensor {', '.join(unheard)} within {seconds:g} s"
        findings.append(Finding("sensors", "note", text, "check that it is on and that its clouds have this frame_id"))
    return findings


def _robot(robot: str, heard: Heard, traffic: Traffic, config: Config) -> list[Finding]:
    findings: list[Finding] = []
    if config.input.robots and robot not in config.input.robots:
        findings.append(Finding(robot, "wrong", "is not in input.robots: all its messages are refused", "add it there"))
    for name, stream in (("clouds", heard.clouds), ("odometry", heard.poses), ("transforms", heard.transforms)):
        findings += _readable(robot, name, stream)
    findings += _clouds(robot, heard, config)
    placed_only = set(heard.cloud_frames) <= {config.map.frame_id}
    if heard.poses.times:
        findings += _poses(robot, heard, config)
        if heard.clouds.times and not placed_only:
            findings += _together(robot, heard, traffic, config)
    elif heard.clouds.times and not placed_only:
        remedy = f"publish the localisation's poses on {config.keys['odometry'].replace('{robot}', robot)}"
        findings.append(Finding(robot, "wrong", "no odometry: its clouds can't be placed", remedy))
    return findings


def _readable(robot: str, name: str, stream: Stream) -> list[Finding]:
    if not stream.faults:
        return []
    fault, number = stream.faults.most_common(1)[0]
    text = f"{stream.faults.total()} of {stream.number} {name} can't be read; {number}: {fault}"
    return [Finding(robot, "wrong", text, "correct the publisher: README.md shows the expected messages")]


def _clouds(robot: str, heard: Heard, config: Config) -> list[Finding]:
    stream = heard.clouds
    if not stream.times:
        return []
    each = heard.points / len(stream.times)
    findings = [
        Finding(
            robot, "ok", f"clouds at {stream.rate:.1f} Hz, {each:,.0f} points each, in {_frames(heard.cloud_frames)}"
        )
    ]
    for frame in heard.cloud_frames:
        if frame != config.map.frame_id and config.sensor(robot, frame) is None:
            text = f"clouds in frame {frame!r} are refused: it is neither the map's frame nor a configured sensor"
            remedy = (
                f"add [sensors.{frame}] with its translation, rotation and range_sigma, or correct the clouds' frame_id"
            )
            findings.append(Finding(robot, "wrong", text, remedy))
    for frame, number in heard.timeless.items():
        text = f"{number} of {heard.cloud_frames[frame]} clouds in {frame!r} have no per-point times (field t)"
        remedy = "let the driver send them: without them, the robot's motion during a sweep smears the ground"
        findings.append(Finding(robot, "note", text, remedy))
    if stream.unnumbered == stream.number:
        text = "clouds have no message_seq (8-byte attachment): lost clouds can't be counted"
        remedy = "attach a number that rises by one, 8 bytes little-endian; this is optional"
        findings.append(Finding(robot, "note", text, remedy))
    return findings


def _poses(robot: str, heard: Heard, config: Config) -> list[Finding]:
    stream, gap, most = heard.poses, largest_gap(heard.poses), config.input.max_pose_gap
    findings = [Finding(robot, "ok", f"odometry at {stream.rate:.1f} Hz, in {_frames(heard.pose_frames)}")]
    if gap > most:
        text = (
            f"poses were up to {gap:.2f} s apart; clouds across more than input.max_pose_gap = {most:g} s are rejected"
        )
        findings.append(Finding(robot, "wrong", text, "publish poses more often, or raise input.max_pose_gap"))
    for frame in sorted(set(heard.pose_frames) - {config.map.frame_id} - heard.child_frames):
        text = f"odometry in frame {frame!r} is rejected: no transform leads to {config.map.frame_id!r}"
        remedy = f"publish that transform, or odometry in {config.map.frame_id!r}, or set map.frame_id"
        # A transform may have been published once, before doctor listened.
        findings.append(Finding(robot, "note" if not heard.transforms.number else "wrong", text, remedy))
    if heard.bad_covariance:
        text = f"{heard.bad_covariance} of {stream.number} poses have an invalid covariance: they are rejected"
        remedy = "send 36 finite numbers, row by row, symmetric, without a negative diagonal; or leave it empty"
        findings.append(Finding(robot, "wrong", text, remedy))
    if heard.unknown_covariance:
        text = f"{heard.unknown_covariance} of {stream.number} poses have no covariance"
        sigma = ", ".join(f"{value:g}" for value in config.input.pose_sigma)
        findings.append(
            Finding(robot, "note", text, f"they get input.pose_sigma = [{sigma}]; check that it is realistic")
        )
    return findings


def _together(robot: str, heard: Heard, traffic: Traffic, config: Config) -> list[Finding]:
    """Check clouds against poses, and both against this machine's clock."""
    findings = []
    apart = heard.clouds.behind - heard.poses.behind
    if abs(apart) > CLOCK_S:
        text = f"stamps of clouds and odometry differ by {abs(apart):.1f} s: they come from different clocks"
        findings.append(Finding(robot, "wrong", text, "synchronise scanner and localisation (PTP, NTP)"))
    elif abs(heard.poses.behind) > CLOCK_S:
        text = f"stamps are {heard.poses.behind:,.1f} s behind this machine's clock"
        findings.append(
            Finding(robot, "note", text, "harmless for the map; if this is not a recording, synchronise the clocks")
        )
    waits, without = pose_waits(heard, traffic.ended)
    limit = config.input.max_wait
    late = sum(wait > limit for wait in waits)
    if without or late:
        text = f"{without + late} of {len(waits) + without} clouds had no pose within input.max_wait = {limit:g} s"
        findings.append(
            Finding(
                robot, "wrong", text, "make the localisation faster, or raise input.max_wait (and input.queue_limit)"
            )
        )
    elif waits:
        findings.append(
            Finding(robot, "ok", f"poses follow their clouds within {max(waits):.2f} s (input.max_wait {limit:g} s)")
        )
    return findings


def _frames(counts: dict[str, int]) -> str:
    return ", ".join(repr(frame) for frame in sorted(counts))
