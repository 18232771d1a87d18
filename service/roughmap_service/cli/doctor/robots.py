"""Whether what the robots publish can become a map."""

from roughmap_schemas.config import Config
from roughmap_service.cli.doctor.findings import Finding, Verdict
from roughmap_service.cli.doctor.traffic import Heard, Stream, Traffic, largest_gap, pose_waits

CLOCK_S = 1.0
"""Stamps that lie so far from this machine's clock are of another clock, or of another day."""


def judge(traffic: Traffic, config: Config, seconds: float) -> list[Finding]:
    """Findings on all that was heard in so many seconds."""
    findings = [
        finding for robot, heard in sorted(traffic.robots.items()) for finding in _robot(robot, heard, traffic, config)
    ]
    silent = sorted(set(config.input.robots) - set(traffic.robots))
    if silent and traffic.robots:
        findings.append(_of("robots", "note", f"nothing from {', '.join(silent)} (input.robots)", "are they on?"))
    frames = {frame for heard in traffic.robots.values() for frame in heard.cloud_frames}
    unheard = sorted(set(config.sensors) - frames)
    if not traffic.robots:
        keys = config.keys["points"].replace("{robot}", "*")
        mend = "start the robots; see that they connect to this service's zenoh.listen, or it to theirs (zenoh.connect)"
        findings.append(_of("robots", "wrong", f"nobody published on {keys} and its like within {seconds:g} s", mend))
    elif unheard:
        told = f"no cloud of sensor {', '.join(unheard)} within {seconds:g} s"
        findings.append(_of("sensors", "note", told, "is it on, and is frame_id of its clouds that name?"))
    return findings


def _of(area: str, verdict: Verdict, text: str, mend: str = "") -> Finding:
    return Finding(area, verdict, text, mend)


def _robot(robot: str, heard: Heard, traffic: Traffic, config: Config) -> list[Finding]:
    findings: list[Finding] = []
    if config.input.robots and robot not in config.input.robots:
        findings.append(_of(robot, "wrong", "is not among input.robots: all of it is refused", "add it there"))
    for name, stream in (("clouds", heard.clouds), ("odometry", heard.poses), ("transforms", heard.transforms)):
        findings += _readable(robot, name, stream)
    findings += _clouds(robot, heard, config)
    placed_only = set(heard.cloud_frames) <= {config.map.frame_id}
    if heard.poses.times:
        findings += _poses(robot, heard, config)
        if heard.clouds.times and not placed_only:
            findings += _together(robot, heard, traffic, config)
    elif heard.clouds.times and not placed_only:
        mend = f"have the localisation publish poses on {config.keys['odometry'].replace('{robot}', robot)}"
        findings.append(_of(robot, "wrong", "no odometry: none of its clouds can be placed", mend))
    return findings


def _readable(robot: str, name: str, stream: Stream) -> list[Finding]:
    if not stream.faults:
        return []
    fault, number = stream.faults.most_common(1)[0]
    told = f"{stream.faults.total()} of {stream.number} {name} can't be read; {number}: {fault}"
    return [_of(robot, "wrong", told, "mend the publisher: README.md shows what is expected")]


def _clouds(robot: str, heard: Heard, config: Config) -> list[Finding]:
    stream = heard.clouds
    if not stream.times:
        return []
    each = heard.points / len(stream.times)
    findings = [
        _of(robot, "ok", f"clouds at {stream.rate:.1f} Hz, {each:,.0f} points each, in {_frames(heard.cloud_frames)}")
    ]
    for frame in heard.cloud_frames:
        if frame != config.map.frame_id and config.sensor(robot, frame) is None:
            told = f"clouds in frame {frame!r}, which is neither the map's nor a configured sensor: all are refused"
            mend = f"add [sensors.{frame}] with its translation, rotation and range_sigma, or mend frame_id"
            findings.append(_of(robot, "wrong", told, mend))
    for frame, number in heard.timeless.items():
        told = f"{number} of {heard.cloud_frames[frame]} clouds in {frame!r} have no per-point times (field t)"
        mend = "have the driver send them: without, what the robot moves during a sweep smears the ground"
        findings.append(_of(robot, "note", told, mend))
    if stream.unnumbered == stream.number:
        told = "clouds carry no message_seq (8 bytes of attachment): what is lost on the way can't be counted"
        mend = "attach a number to each that rises by one, 8 bytes, little-endian; or do without"
        findings.append(_of(robot, "note", told, mend))
    return findings


def _poses(robot: str, heard: Heard, config: Config) -> list[Finding]:
    stream, gap, most = heard.poses, largest_gap(heard.poses), config.input.max_pose_gap
    findings = [_of(robot, "ok", f"odometry at {stream.rate:.1f} Hz, in {_frames(heard.pose_frames)}")]
    if gap > most:
        told = (
            f"poses were up to {gap:.2f} s apart; clouds across more than input.max_pose_gap = {most:g} s are rejected"
        )
        findings.append(_of(robot, "wrong", told, "publish poses more often, or raise input.max_pose_gap"))
    for frame in sorted(set(heard.pose_frames) - {config.map.frame_id} - heard.child_frames):
        told = (
            f"odometry in frame {frame!r}, which no transform leads to {config.map.frame_id!r}: its poses are rejected"
        )
        mend = f"publish that transform, or odometry in {config.map.frame_id!r}, or set map.frame_id"
        # A transform may be published once, before anyone listened: the service, were it up, would have it.
        findings.append(_of(robot, "note" if not heard.transforms.number else "wrong", told, mend))
    if heard.bad_covariance:
        told = f"{heard.bad_covariance} of {stream.number} poses have a covariance that is none: they are rejected"
        mend = "36 finite numbers, row by row, symmetric, no negative diagonal; or none at all"
        findings.append(_of(robot, "wrong", told, mend))
    if heard.unknown_covariance:
        told = f"{heard.unknown_covariance} of {stream.number} poses say nothing of their covariance"
        sigma = ", ".join(f"{value:g}" for value in config.input.pose_sigma)
        findings.append(_of(robot, "note", told, f"input.pose_sigma = [{sigma}] holds for them: is that true?"))
    return findings


def _together(robot: str, heard: Heard, traffic: Traffic, config: Config) -> list[Finding]:
    """Do clouds and poses fit each other, and this machine's clock?"""
    findings = []
    apart = heard.clouds.behind - heard.poses.behind
    if abs(apart) > CLOCK_S:
        told = f"stamps of clouds and odometry differ by {abs(apart):.1f} s: they come from two clocks"
        findings.append(_of(robot, "wrong", told, "synchronise scanner and localisation (PTP, NTP)"))
    elif abs(heard.poses.behind) > CLOCK_S:
        told = f"stamps lie {heard.poses.behind:,.1f} s behind this machine's clock"
        findings.append(_of(robot, "note", told, "no harm to the map; if it is no recording, set the clocks"))
    waits, without = pose_waits(heard, traffic.ended)
    limit = config.input.max_wait
    late = sum(wait > limit for wait in waits)
    if without or late:
        told = f"{without + late} of {len(waits) + without} clouds got no pose within input.max_wait = {limit:g} s"
        findings.append(
            _of(robot, "wrong", told, "speed up the localisation, or raise input.max_wait (and queue_limit)")
        )
    elif waits:
        findings.append(
            _of(robot, "ok", f"poses follow their clouds within {max(waits):.2f} s (input.max_wait {limit:g} s)")
        )
    return findings


def _frames(counts: dict[str, int]) -> str:
    return ", ".join(repr(frame) for frame in sorted(counts))
