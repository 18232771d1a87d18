"""Why most clouds of a recording are not in the map, and what to do: one line."""

from collections import Counter
from collections.abc import Collection
from typing import Final

from roughmap_schemas import Config
from roughmap_schemas.reasons import MEANING, CloudReason, PoseReason
from roughmap_service.inputs.remedies import in_one_line, sensor_table
from roughmap_service.offline.message_run import TAKEN, Counts
from roughmap_service.run.inbox import INTEGRATED

CLOUD_REMEDIES: Final = {
    "no_pose": (
        "the recorded poses don't reach around their times: look whether odometry and {sensor} use one clock, or set "
        "time_offset in {table}"
    ),
    "no_extrinsics": (
        "tf has no way from the robot's base to {sensor}: set translation and rotation in {table}, or record /tf_static"
    ),
    "pose_gap": "raise input.max_pose_gap, as in --set input.max_pose_gap=1.0",
    "pose_jump": "look at the recorded poses; raise input.max_leap if the robot does move like that",
    "late": "raise input.pose_history, as in --set input.pose_history=60",
    "too_many_tiles": "set max_range in {table}, or raise map.cell_size",
    "empty": "look at min_range, max_range and exclude in {table}, and that the points are in metres",
    "overload": "raise input.queue_limit",
    "clock_reset": "two programs gave poses, or the clock was set: choose one topic by --odometry",
    "clock_offset": "set time_offset in {table}",
    "time_form": 'set time_field, time_unit and time_origin in {table}; time_field = "none" maps without them',
}

POSE_REMEDIES: Final = {
    "pose_frame": "name the frame that they are in: --set map.frame_id=FRAME",
    "bad_covariance": "set pose_covariance in [robots.{robot}]",
}


def why_unmapped(counts: Counts, config: Config, robot: str, sensors: Collection[str]) -> str | None:
    """Return why most clouds were lost; None if most are in the map, or there were none."""
    lost = Counter(counts.clouds)
    mapped = lost.pop(INTEGRATED, 0)
    refused = sum(counts.refused.values()) if counts.lost else 0
    if mapped >= sum(lost.values()) + refused or not (lost or refused):
        return None
    total = mapped + sum(lost.values())
    if not lost or refused > sum(lost.values()):
        return in_one_line(f"most clouds were refused: {counts.lost}")
    reason, number = lost.most_common(1)[0]
    frame = min(sensors, default="the sensor")
    words = {"sensor": frame, "table": sensor_table(config, robot, frame), "robot": robot}
    poses = Counter(counts.poses)
    taken = poses.pop(TAKEN, 0)
    if reason == CloudReason.NO_POSE and sum(poses.values()) > taken:
        why, bad = poses.most_common(1)[0]
        meaning = MEANING[PoseReason][why]
        remedy = POSE_REMEDIES.get(why, "look at the recorded poses").format_map(words)
        return in_one_line(
            f"{number:,} of {total:,} clouds were rejected as {reason}, since {bad:,} of {bad + taken:,} poses were "
            f"rejected as {why} ({meaning}); {remedy}"
        )
    if reason == CloudReason.NO_POSE and not taken:
        return in_one_line(f"{number:,} of {total:,} clouds were rejected as {reason}: no poses came; give --odometry")
    meaning = MEANING[CloudReason][reason]
    remedy = CLOUD_REMEDIES[reason].format_map(words)
    return in_one_line(f"{number:,} of {total:,} clouds were rejected as {reason} ({meaning}); {remedy}")
