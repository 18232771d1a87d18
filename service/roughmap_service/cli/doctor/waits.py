"""How long clouds wait for the poses that place them."""

from collections.abc import Sequence

import numpy as np

from roughmap_service.cli.doctor.heard import Heard
from roughmap_service.run.settings import NS


def pose_waits(clouds: Sequence[Heard], poses: Sequence[Heard], ended_ns: int) -> tuple[list[float], int]:
    """Return for each cloud how many seconds later the pose arrived that covers it, and how many had none.

    The clouds' stamps are the times of their last points. A cloud that arrived less than 1 s before ``ended_ns``, the
    end of listening, does not count as one without a pose.
    """
    covered: list[Heard] = []  # arrivals at which the newest stamp rose
    for pose in poses:
        if not covered or pose.stamp_ns > covered[-1].stamp_ns:
            covered.append(pose)
    stamps = np.array([pose.stamp_ns for pose in covered], np.int64)
    waits, without = [], 0
    for cloud in clouds:
        at = int(np.searchsorted(stamps, cloud.stamp_ns))
        if at < len(covered):
            waits.append(max(covered[at].arrival_ns - cloud.arrival_ns, 0) / NS)
        elif ended_ns - cloud.arrival_ns > NS:
            without += 1
    return waits, without
