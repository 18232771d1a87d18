"""Judges a robot's poses: rate, gaps, frames and transforms, leaps, bursts, jitter."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from roughmap_schemas.config import Config
from roughmap_service.cli.doctor.findings import Finding, table
from roughmap_service.cli.doctor.heard import HeardPose, HeardTransform, rate, times
from roughmap_service.run.habits import BURST_REMEDY, JITTER_REMEDY, find_bursts, find_jitter, later_transform
from roughmap_service.run.leaps import Leap, find_leap
from roughmap_service.run.poses import Pose
from roughmap_service.run.settings import NS

MAX_FOLLOWED = 5_000
"""Poses in a row whose motion is followed: the last ones."""

MAX_FRAMES = 64
"""Frames of odometry that are told apart."""

KEEP_RADIUS_M = 30.0
"""What a robot without a global frame may keep around it: dead reckoning drifts by about 1 % of the way."""

KEEP = table(("map", "keep"), {"radius": KEEP_RADIUS_M})


def judge_poses(robot: str, poses: Sequence[HeardPose], rows: Sequence[Sequence[int]], config: Config) -> list[Finding]:
    """Judge how often the poses come and how they move; ``rows``: the indices of those with rising stamps."""
    stamped = [[poses[at] for at in row] for row in rows]
    frames = Counter(pose.frame_id for pose in poses)
    text = f"odometry at {rate(times(poses)):.1f} Hz, in {named(frames)}"
    findings = [Finding(robot, "ok", text)]
    gap, most = largest_gap(stamped), config.input.max_pose_gap
    if gap > most:
        text = (
            f"poses were up to {gap:.2f} s apart; clouds across more than input.max_pose_gap = {most:g} s are rejected"
        )
        steps = [(b.stamp_ns - a.stamp_ns) / NS for row in stamped for a, b in pairwise(row)]
        remedy, settings = "publish poses more often, or raise input.max_pose_gap", ""
        if (usual := float(np.median(steps))) > most:  # always so, not now and then
            enough = round(1.5 * usual, 1)
            remedy = "publish poses more often, or wait for them longer:"
            values = {"max_pose_gap": enough, "max_wait": max(enough, config.input.max_wait)}
            settings = table(("input",), values)
        findings.append(Finding(robot, "wrong", text, remedy, settings))
    bursts = find_bursts([[pose.stamp_ns for pose in row] for row in stamped])
    if bursts is not None:
        findings.append(Finding(robot, "wrong", str(bursts), BURST_REMEDY))
    for frame in sorted(frames)[:MAX_FRAMES]:
        of_frame = [[pose for pose in row if pose.frame_id == frame] for row in stamped]
        followed, found = follow(of_frame, config)
        if found:
            findings.append(_leapt(robot, found, config))
        elif bursts is None and (jitter := find_jitter(followed)) is not None:
            findings.append(Finding(robot, "wrong", f"odometry in {frame!r} {jitter}", JITTER_REMEDY))
    return findings


def largest_gap(rows: Sequence[Sequence[HeardPose]]) -> float:
    """Return the largest difference of neighbouring stamps in s, within rows of rising stamps."""
    return max((b.stamp_ns - a.stamp_ns for row in rows for a, b in pairwise(row)), default=0) / NS


def follow(rows: Sequence[Sequence[HeardPose]], config: Config) -> tuple[list[list[Pose]], list[Leap]]:
    """Follow poses of one frame, in rows of rising stamps. Return them as the service keeps them, and the leaps."""
    limits = config.input.max_leap, config.input.max_acceleration, config.input.max_speed
    leaps: list[Leap] = []
    followed: list[list[Pose]] = []
    for row in rows:
        poses: list[Pose] = []
        for heard in row[-MAX_FOLLOWED:]:
            poses.append(Pose(heard.stamp_ns, heard.position, heard.rotation, None, 0, 0))
            leap = find_leap(poses, len(poses) - 1, *limits)
            if leap is not None:
                leaps.append(leap)
                poses[-1] = replace(poses[-1], leapt=True)
        followed.append(poses)
    return followed, leaps


def _leapt(robot: str, leaps: Sequence[Leap], config: Config) -> Finding:
    worst = max(leaps, key=lambda leap: (leap.metres, leap.radians))
    far = f"{worst.metres:.2f} m" if worst.metres > 0.01 else f"{worst.radians:.2f} rad"
    text = (
        f"odometry leapt {f'{len(leaps)} times, at most' if len(leaps) > 1 else 'by'} {far} within "
        f"{worst.seconds * 1e3:.0f} ms: clouds across a leap are rejected (pose_jump)"
    )
    remedy = (
        "let odometry run smoothly in a frame of its own (odom) and publish corrections as the transform from "
        f"{config.map.frame_id!r} to it; if the robot does move so, raise input.max_leap"
    )
    return Finding(robot, "wrong", text, remedy)


def judge_frames(
    robot: str, poses: Sequence[HeardPose], transforms: Sequence[HeardTransform], config: Config
) -> list[Finding]:
    """Judge whether all odometry can be brought into the map's frame, and the transforms that do it."""
    frame_id = config.map.frame_id
    lead = {one.child: one for one in transforms if one.parent == frame_id}
    findings = []
    for frame in sorted({pose.frame_id for pose in poses} - {frame_id} - set(lead))[:MAX_FRAMES]:
        text = f"odometry in frame {frame!r} is rejected (pose_frame): no transform leads to {frame_id!r}"
        if not transforms:  # one may have been published once, before doctor listened
            text = f"odometry is in frame {frame!r}: no transform to {frame_id!r} came; without one, it is rejected"
        if frame.strip("/") == frame_id.strip("/"):
            text = f"odometry in frame {frame!r} is rejected (pose_frame): the map's frame is {frame_id!r}"
            remedy = "publish it without the slash, or name the map's frame so (which needs a new run, --fresh):"
            findings.append(Finding(robot, "wrong", text, remedy, table(("map",), {"frame_id": frame})))
            continue
        slashed = [one for one in (*lead, *(t.parent for t in transforms)) if one.strip("/") == frame.strip("/")]
        remedy, settings = f"publish that transform, or odometry in {frame_id!r}, or set map.frame_id", ""
        if slashed:
            remedy = f"use one name: transforms have {slashed[0]!r}, without or with a leading slash"
        elif drifts(frame):
            remedy = (
                f"publish that transform, or odometry in {frame_id!r}; without a localisation, map in {frame!r} and "
                "forget what the robot left behind (which needs a new run, --fresh):"
            )
            settings = "\n".join((table(("map",), {"frame_id": frame}), KEEP))
        findings.append(Finding(robot, "wrong" if transforms else "note", text, remedy, settings))
    unused = [one for one in transforms if not _mounts(robot, one.child, config)]
    for parent in sorted({one.parent for one in unused} - {frame_id})[:MAX_FRAMES]:
        slash = parent.strip("/") == frame_id.strip("/")
        text = f"transforms from {parent!r} are not used: the map's frame is {frame_id!r}"
        remedy = (
            "publish them without the slash"
            if slash
            else f"publish the transform from {frame_id!r} to the odometry's frame"
        )
        findings.append(Finding(robot, "wrong" if slash else "note", text, remedy))
    forgets = math.isfinite(config.map.keep.radius)
    if drifts(frame_id) and not forgets and any(pose.frame_id == frame_id for pose in poses):
        text = f"odometry in {frame_id!r}, the map's own frame, drifts: old ground becomes false steps"
        remedy = "let the map forget what the robots left behind:"
        findings.append(Finding(robot, "note", text, remedy, KEEP))
    for child in sorted(lead):
        own = [pose for pose in poses if pose.frame_id == child]
        findings += _later(
            robot, child, own, [one for one in transforms if one.parent == frame_id and one.child == child]
        )
    return findings


def _mounts(robot: str, child: str, config: Config) -> bool:
    """Return whether transforms to this frame say where a sensor is mounted."""
    sensor = config.sensor(robot, child)
    return sensor is not None and sensor.extrinsics == "transform"


def drifts(frame: str) -> bool:
    """Return whether a frame's name says that it is one of dead reckoning, as ROS has it (REP 105): odom."""
    return "odom" in frame.lower()


def _later(robot: str, child: str, poses: Sequence[HeardPose], transforms: Sequence[HeardTransform]) -> list[Finding]:
    """Judge transforms that are stamped later than all the poses that need them."""
    if not poses:
        return []
    newest = max(pose.stamp_ns for pose in poses)
    early = min(one.stamp_ns for one in transforms)
    text = later_transform(child, early - newest)
    if text is None or newest == 0:
        return []
    if len({one.stamp_ns for one in transforms}) == 1:
        return [Finding(robot, "note", text, "give a static transform the stamp 0")]
    remedy = "let odometry and transforms be stamped by one clock; give a static transform the stamp 0"
    return [Finding(robot, "wrong", text, remedy)]


def named(frames: Sequence[str] | Counter[str]) -> str:
    """Return names for a text, each in quotation marks."""
    return ", ".join(repr(frame) for frame in sorted(frames)[:MAX_FRAMES])
