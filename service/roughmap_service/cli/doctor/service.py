"""Judges what a running service made of the robots' messages while doctor listened."""

from collections.abc import Collection, Mapping
from typing import Any

from roughmap_schemas.messages import MapStatus
from roughmap_schemas.reasons import CloudReason
from roughmap_service.cli.doctor.findings import Finding, Verdict

MOST = 0.9
"""Part of the clouds, points or poses that must come to nothing to be wrong."""

ENOUGH = 5
"""Clouds or poses that must have been decided meanwhile."""


def judge_service(before: MapStatus, after: MapStatus, told: Collection[str] = ()) -> list[Finding]:
    """Compare two statuses of one service; the later one also names its problems, and what happened lately.

    ``told``: subjects of problems on which there are findings already.
    """
    problems = {subject: sentence for subject, sentence in after.problems.items() if subject not in told}
    findings = [Finding("service", "wrong", sentence) for _, sentence in sorted(problems.items())]
    findings += [Finding("service", "note", f"recently: {sentence}") for sentence in after.recent]
    if before.instance != after.instance:
        return findings
    clouds_lost = False
    for what, good, rejected in (
        (
            "clouds",
            after.clouds.accepted - before.clouds.accepted,
            _rise(before.clouds.rejected, after.clouds.rejected),
        ),
        (
            "points",
            after.points.accepted - before.points.accepted,
            _rise(before.points.rejected, after.points.rejected),
        ),
        ("poses", after.poses.accepted - before.poses.accepted, _rise(before.poses.rejected, after.poses.rejected)),
        ("messages", 0, _rise(before.refused, after.refused)),
    ):
        bad = sum(rejected.values())
        reasons = ", ".join(f"{reason} {number:,}" for reason, number in rejected.items())
        if what == "messages" and bad:
            findings.append(
                Finding("service", "note", f"refused {bad} messages meanwhile: {reasons}", "see above for the cause")
            )
        elif what == "points" and clouds_lost:
            continue  # those of clouds that came to nothing
        elif bad >= ENOUGH and bad > MOST * (good + bad):
            text = f"rejected {bad:,} of {good + bad:,} {what} meanwhile: {reasons}"
            verdict: Verdict = "note" if after.problems else "wrong"
            findings.append(Finding("service", verdict, text, "see above for the cause"))
            clouds_lost = what == "clouds"
    return findings


def knows_mountings(before: MapStatus | None, after: MapStatus | None) -> bool:
    """Return whether the service knew meanwhile where all sensors are mounted: clouds were mapped, none lacked it."""
    if before is None or after is None or before.instance != after.instance:
        return False
    mapped = after.clouds.accepted > before.clouds.accepted
    return mapped and CloudReason.NO_EXTRINSICS not in _rise(before.clouds.rejected, after.clouds.rejected)


def _rise(before: Mapping[Any, int], after: Mapping[Any, int]) -> dict[str, int]:
    return {str(reason): rise for reason, number in after.items() if (rise := number - before.get(reason, 0)) > 0}
