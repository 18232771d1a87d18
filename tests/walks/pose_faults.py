"""Faults of odometry, its frames and covariances."""

import math
from dataclasses import replace
from random import Random

import numpy as np
import walks_paths  # noqa: F401 - before what it makes importable
from walk_fault import Fault, Names, of_odometry
from walker import Effect, Message

# Poses


def leap(random: Random) -> Fault:
    to = random.uniform(0.6, 5.0) * random.choice((-1, 1))
    names = Names(
        log=("leap", r"leapt \d+\.\d\d m"), health=r"its pose leapt \d+\.\d\d m", doctor="odometry leapt by",
        advice="odom", lasting=False, of_sensor=False,
    )  # fmt: skip

    def move(m: Message) -> list[Message]:
        x, y, z = m.position
        return [replace(m, position=(x, y + to, z))]

    return Fault(of_odometry(move), names, f"by {abs(to):.2f} m")


def leaps(random: Random) -> Fault:
    to, numbers = random.uniform(0.6, 3.0), iter(range(1 << 62))
    names = Names(
        log=("stream_lost pose_jump", r"it moved \d+\.\d\d m in"), health=r"it moved \d+\.\d\d m in",
        doctor=r"odometry leapt \d+ times", advice="odom",
    )  # fmt: skip

    def move(m: Message) -> list[Message]:
        x, y, z = m.position
        return [replace(m, position=(x, y + to * (next(numbers) // 2 % 2), z))]

    return Fault(of_odometry(move), names, f"by {to:.2f} m again and again")


def restarts_at_origin(random: Random) -> Fault:
    first: list[tuple[float, ...]] = []

    def restart(m: Message) -> list[Message]:
        first.append(m.position)
        x, y, z = (p - f for p, f in zip(m.position, first[0], strict=True))
        return [replace(m, position=(x, y, z))]

    names = Names(
        log=("leap", r"leapt \d+\.\d\d m"), health=r"its pose leapt \d+\.\d\d m", doctor="odometry leapt by",
        advice="odom", lasting=False, of_sensor=False,
    )  # fmt: skip
    return Fault(of_odometry(restart), names)


def no_odometry(random: Random) -> Fault:
    names = Names(
        log=("stream_lost no_pose", r"its last odometry came \d+ s ago|newest pose is"),
        health=r"its last odometry came \d+ s ago|the newest pose is [\d.]+ s behind",
        doctor="no odometry: its clouds can't be placed", advice="publish the localisation's poses",
    )  # fmt: skip
    return Fault(of_odometry(lambda m: []), names)


def never_odometry(random: Random) -> Fault:
    names = Names(
        log=("stream_lost no_pose", "no odometry has come from the robot"), health="no odometry has come",
        doctor="no odometry: its clouds can't be placed", advice="publish the localisation's poses",
    )  # fmt: skip
    return Fault(of_odometry(lambda m: []), names)


def odometry_slow(random: Random) -> Fault:
    period, last = random.uniform(0.7, 1.4), [-math.inf]

    def thin(m: Message) -> list[Message]:
        if m.made < last[0] + period:
            return []
        last[0] = m.made
        return [m]

    names = Names(
        log=("stream_lost (pose_gap|no_pose)", rf"{period - 0.05:.1f}\d* s apart.*|poses are .* apart.*publish poses"),
        health="poses are .* apart.*publish poses more often",
        doctor=r"poses were up to \d\.\d\d s apart", advice="more often|input.max_pose_gap",
    )  # fmt: skip
    return Fault(of_odometry(thin), names, f"every {period:.2f} s")


def frame_slash(random: Random) -> Fault:
    names = Names(
        log=("stream_lost pose_frame", 'their frame is "/map".*write their frame as "map"'),
        health='write their frame as "map"', doctor=r"odometry in frame '/map' is rejected \(pose_frame\)",
        advice="slash", of_sensor=False,
    )  # fmt: skip
    return Fault(of_odometry(lambda m: [replace(m, frame="/map")]), names)


def no_transform(random: Random) -> Fault:
    frame = random.choice(("odom", "world", "camera_init"))
    names = Names(
        log=("stream_lost pose_frame", f'their frame is "{frame}".*publish a transform'), health="publish a transform",
        doctor=rf"odometry is in frame '{frame}': no transform to 'map' came", advice="publish that transform",
        verdict="note", of_sensor=False,
    )  # fmt: skip
    return Fault(of_odometry(lambda m: [replace(m, frame=frame)]), names, f"from {frame!r}")


# Covariances


def _covariance(matrix: np.ndarray) -> Effect:
    return of_odometry(lambda m: [replace(m, covariance=matrix)])


def covariance_wide(random: Random) -> Fault:
    sigma = random.uniform(0.28, 1.5)
    matrix = np.diag([sigma**2, sigma**2, 1e-4, 1e-5, 1e-5, 1e-5])
    said = rf"2 sigma = {2 * sigma:.2f} m, map\.max_horizontal_radius = 0\.5"
    names = Names(
        log=("stream_lost uncertain", said), health=rf'{said}.*\[robots\.covariance_wide\] pose_covariance = "cap"',
        doctor=rf"rejected as uncertain: .*2 sigma = {2 * sigma:.2f} m", advice='pose_covariance = "cap"',
    )  # fmt: skip
    return Fault(_covariance(matrix), names, f"sigma {sigma:.2f} m")


def covariance_high(random: Random) -> Fault:
    sigma = random.uniform(0.55, 5.0)
    matrix = np.diag([1e-4, 1e-4, sigma**2, 1e-5, 1e-5, 1e-5])
    said = rf"sigma z = {sigma:.2f} m, map\.max_vertical_sigma = 0\.5"
    names = Names(
        log=("stream_lost uncertain", said), health=rf'{said}.*\[robots\.covariance_high\] pose_covariance = "cap"',
        doctor=rf"rejected as uncertain: .*height error.* = {sigma:.2f} m", advice='pose_covariance = "cap"',
    )  # fmt: skip
    return Fault(_covariance(matrix), names, f"sigma z {sigma:.2f} m")


def covariance_not_psd(random: Random) -> Fault:
    matrix = np.diag([3e-3, 1e-4, 1e-4, 1e-6, 1e-6, 1e-4])
    if random.random() < 0.5:
        matrix[0, 1] = matrix[1, 0] = random.uniform(1.2, 3.0) * math.sqrt(matrix[0, 0] * matrix[1, 1])
    else:  # each pair alone is possible
        c = random.uniform(0.75, 0.95)
        for i, j, sign in ((0, 1, 1), (1, 2, 1), (0, 2, -1)):
            matrix[i, j] = matrix[j, i] = sign * c * math.sqrt(matrix[i, i] * matrix[j, j])
    wrong = "positive semidefinite|larger than its variances allow"
    names = Names(
        log=("stream_lost bad_covariance", wrong), health=f"({wrong}).*or send none",
        doctor=f"invalid covariance: .*({wrong})", advice="positive semidefinite", of_sensor=False,
    )  # fmt: skip
    return Fault(_covariance(matrix), names)


def covariance_unknown(random: Random) -> Fault:
    if random.random() < 0.5:
        told, matrix = "1e6", np.diag([1e-3, 1e-3, 1e6, 1e6, 1e6, 1e-3])
    else:
        told, matrix = "-1", np.zeros((6, 6))
        matrix[0, 0] = -1.0
    names = Names(
        log=("covariance_unknown", "input.pose_sigma stands in"), health="does not estimate all of its covariance",
        doctor="have no estimate of", advice="pose_sigma", lasting=False, of_sensor=False,
    )  # fmt: skip
    return Fault(_covariance(matrix), names, told)
