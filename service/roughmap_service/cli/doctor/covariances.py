"""Judges the covariances of a robot's poses against the limits on a point's error."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from roughmap_schemas.config import Config
from roughmap_schemas.odometry import read_covariance
from roughmap_schemas.robot_sections import Policy
from roughmap_service.cli.doctor.findings import Finding, Verdict, table
from roughmap_service.cli.doctor.heard import HeardPose
from roughmap_service.run.covariances import UNKNOWN_VARIANCE, BadCovariance, settle
from roughmap_service.run.settings import NS

AXES = ("x", "y", "z", "roll", "pitch", "yaw")

MAX_JUDGED = 500
"""Poses whose covariances are judged, evenly over all."""

GROWS = 1.2
"""Factor by which an error must grow to be told: from the first to the last tenth of the poses."""

SOON_S = 600.0
"""A limit that is reached later is not told, in seconds."""

Floats = npt.NDArray[np.float64]


@dataclass
class Covariances:
    """What the covariances of some poses are like.

    Attributes:
        number: poses that were judged.
        none: poses without a covariance.
        faults: what is wrong with invalid ones.
        unknown: axes without an estimate, by how often; all six count for a matrix that holds -1 alone.
        exact: axes of variance 0.
        sigmas: (M, 6) standard deviations as they are used, of the poses with a valid covariance.
        stamps: (M,) their stamps in s after the first.
    """

    number: int = 0
    none: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    unknown: Counter[str] = field(default_factory=Counter)
    exact: Counter[str] = field(default_factory=Counter)
    sigmas: Floats = field(default_factory=lambda: np.empty((0, 6)))
    stamps: Floats = field(default_factory=lambda: np.empty(0))


def look(poses: Sequence[HeardPose], pose_sigma: Floats, policy: Policy) -> Covariances:
    """Look at the covariances of poses, as they are after the configuration's ``policy``."""
    found, sigmas, stamps = Covariances(), [], []
    for pose in poses[:: -(-len(poses) // MAX_JUDGED) or 1]:
        found.number += 1
        if not any(pose.covariance):
            found.none += 1
            continue
        matrix, fault = read_covariance(pose.covariance)
        if matrix is None:
            found.faults[fault] += 1
            continue
        try:
            settled = settle(matrix, pose_sigma, policy)
        except BadCovariance as error:
            found.faults[str(error)] += 1
            continue
        found.unknown.update(AXES[i] for i in settled.unestimated)
        if len(settled.unestimated) < len(AXES):
            found.exact.update(axis for axis, variance in zip(AXES, matrix.diagonal(), strict=True) if variance == 0.0)
        used = np.square(pose_sigma) if settled.covariance is None else settled.covariance.diagonal()
        sigmas.append(np.sqrt(used))
        stamps.append((pose.stamp_ns - poses[0].stamp_ns) / NS)
    if sigmas:
        found.sigmas, found.stamps = np.array(sigmas), np.array(stamps)
    return found


def judge_covariances(
    robot: str, poses: Sequence[HeardPose], ranges: tuple[float, float, float] | None, config: Config
) -> list[Finding]:
    """Return what is wrong with the covariances of a robot's poses.

    ``ranges``: distances in metres that 10, 50 and 90 % of the points don't reach; None if no clouds came.
    """
    policy = config.pose_covariance(robot)
    found = look(poses, np.array(config.input.pose_sigma, np.float64), policy)
    findings = []
    sigma = f"input.pose_sigma = [{', '.join(f'{value:g}' for value in config.input.pose_sigma)}]"
    if found.faults:
        fault, _ = found.faults.most_common(1)[0]
        text = f"{found.faults.total()} of {found.number} poses are rejected for an invalid covariance: {fault}"
        remedy = "send 36 finite numbers, row by row, symmetric and positive semidefinite, or leave it empty"
        findings.append(Finding(robot, "wrong", text, remedy))
    if found.none:
        text = f"{found.none} of {found.number} poses have no covariance"
        findings.append(Finding(robot, "note", text, f"they get {sigma}; check that it is realistic"))
    if found.unknown:
        findings.append(_unknown(robot, found, policy, config, sigma))
    if found.exact and not found.unknown and policy in {"message", "cap"}:
        axes = [axis for axis in AXES if found.exact[axis]]
        text = f"the covariance says that {_named(axes)} {'is' if len(axes) == 1 else 'are'} exact (variance 0)"
        remedy = f"if that is not meant, give it the least error of {sigma}:"
        settings = table(("robots", robot), {"pose_covariance": "floor"})
        findings.append(Finding(robot, "note", text, remedy, settings))
    if len(found.sigmas):
        findings += _limits(robot, found, ranges, config)
    findings.append(_confidence(robot, found, config))
    return findings


def _confidence(robot: str, found: Covariances, config: Config) -> Finding:
    """Say what the layer `confidence` rests on."""
    height = float(np.median(found.sigmas[:, 2])) if len(found.sigmas) else config.input.pose_sigma[2]
    lasting = config.pose_error_time(robot)
    text = (
        f"the poses' heights have a sigma of {height:.3g} m; their errors last for {lasting:g} s (pose_error_time): "
        "the map's confidence is only as good as these two"
    )
    return Finding(robot, "ok", text)


def _unknown(robot: str, found: Covariances, policy: Policy, config: Config, sigma: str) -> Finding:
    """Judge variances that stand for "not estimated". Once the operator set what stands in, all is well."""
    axes = [axis for axis in AXES if found.unknown[axis]]
    number = max(found.unknown.values())
    text = (
        f"{number} of {found.number} poses have no estimate of {_named(axes)}: a variance of -1, or of "
        f"{UNKNOWN_VARIANCE[0]:g} m^2 or {UNKNOWN_VARIANCE[3]:g} rad^2 and more"
    )
    if "pose_sigma" in config.input.model_fields_set or policy == "configured":
        return Finding(robot, "ok", f"{text}; they get {sigma}")
    remedy = "let the localisation estimate them, or set what they get; these values are the defaults, check them:"
    settings = table(("input",), {"pose_sigma": list(config.input.pose_sigma)})
    return Finding(robot, "wrong", text, remedy, settings)


@dataclass(frozen=True)
class Limit:
    """A limit on the error of points: ``factor`` times the sigma of ``place`` and, at a distance, of ``turn``."""

    name: str
    setting: str
    metres: float
    factor: float
    place: tuple[int, ...]
    turn: tuple[int, ...]
    angle: str

    def own(self, sigmas: Floats) -> Floats:
        """Return the error of points beside the robot, in metres, for each pose (M, 6)."""
        largest: Floats = self.factor * sigmas[:, self.place].max(axis=1)
        return largest

    def reach(self, sigmas: Floats) -> float:
        """Return the distance in metres from which on the usual pose makes points too uncertain."""
        own, turning = np.median(self.own(sigmas)), np.median(sigmas[:, self.turn].max(axis=1))
        return math.sqrt(max(self.metres**2 - float(own) ** 2, 0.0)) / max(self.factor * float(turning), 1e-12)


def _limits(robot: str, found: Covariances, ranges: tuple[float, float, float] | None, config: Config) -> list[Finding]:
    """Compare the error that the pose alone gives to points with the limits on it."""
    m = config.map
    if m.error_model == "point":
        return []
    limits = (
        Limit(
            "horizontal error", "map.max_horizontal_radius", m.max_horizontal_radius, m.coverage, (0, 1), (5,), "yaw"
        ),
        Limit("height error", "map.max_vertical_sigma", m.max_vertical_sigma, 1.0, (2,), (3, 4), "roll or pitch"),
    )
    findings = []
    for limit in limits:
        if math.isfinite(limit.metres):
            findings += _judge_limit(robot, limit, found, ranges, config)
    return findings


def _judge_limit(
    robot: str, limit: Limit, found: Covariances, ranges: tuple[float, float, float] | None, config: Config
) -> list[Finding]:
    own, reach = limit.own(found.sigmas), limit.reach(found.sigmas)
    figure, compared = f"{limit.factor:g} sigma", f"{limit.setting} = {limit.metres:g}"
    capped = np.minimum(found.sigmas, config.input.pose_sigma)
    helps = not (limit.own(capped) > limit.metres).any() and (ranges is None or limit.reach(capped) >= ranges[1])
    remedy = f"if the covariance is too large, correct it; else raise {limit.setting} (which needs a new run, --fresh)"
    remedy += ", or cap the error at input.pose_sigma:" if helps else ""
    settings = table(("robots", robot), {"pose_covariance": "cap"}) if helps else ""
    if over := int((own > limit.metres).sum()):
        share = "all points" if over == len(own) else f"all points of {100 * over / len(own):.0f} % of the poses"
        own_error = f"the pose's {limit.name} alone is {figure} = {own.max():.2f} m"
        text = f"{share} are rejected as uncertain: {own_error}, {compared}"
        return [Finding(robot, "wrong", text, remedy, settings)]
    if ranges is not None and reach < ranges[2]:
        verdict: Verdict = "wrong" if reach < ranges[1] else "note"
        turning = float(np.median(found.sigmas[:, limit.turn].max(axis=1)))
        text = (
            f"points beyond {reach:.1f} m are rejected as uncertain: the pose's sigma of {limit.angle} is "
            f"{turning:.3f} rad, {compared}"
        )
        return [Finding(robot, verdict, text, remedy, settings)]
    if grows := _reached(own, found.stamps, limit.metres):
        text = (
            f"the pose's {limit.name} ({figure}) grows {grows}; beyond {compared} all points are rejected as uncertain"
        )
        return [Finding(robot, "note", text, "bound it: correct the dead reckoning by a localisation")]
    return []


def _reached(own: Floats, stamps: Floats, limit: float) -> str:
    """Return how an error grows that will soon be over its limit; nothing if it does not."""
    tenth = max(len(own) // 10, 1)
    first, last = float(np.median(own[:tenth])), float(np.median(own[-tenth:]))
    took = float(np.median(stamps[-tenth:]) - np.median(stamps[:tenth]))
    if took < 1.0 or last < GROWS * first or last - first < 1e-3:
        return ""
    left = (limit - last) / ((last - first) / took)
    return f"from {first:.2f} to {last:.2f} m in {took:.0f} s ({left:.0f} s are left)" if left < SOON_S else ""


def _named(axes: Sequence[str]) -> str:
    return axes[0] if len(axes) == 1 else f"{', '.join(axes[:-1])} and {axes[-1]}"
