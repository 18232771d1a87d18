"""The rules on poses of version 1, by stamps alone, for logs that were made under them."""

from roughmap_schemas import PoseReason
from roughmap_service.run.poses import Pose, PoseBuffer

STALE_ROW = 10
"""Stale poses in a row, with rising stamps, after which the robot's clock counted as set back."""


class StampOrder:
    """Takes poses in the order of their stamps, wherever they arrive in the history."""

    def __init__(self) -> None:
        self.stale_row = 0
        self.stale_stamp_ns = -1

    def add(self, buffer: PoseBuffer, pose: Pose) -> PoseReason | None:
        """Add a pose. Return why it is rejected; None if it was added."""
        if pose.stamp_ns < buffer.horizon_ns:
            rising = pose.stamp_ns > self.stale_stamp_ns
            self.stale_row = self.stale_row + 1 if rising else 1
            self.stale_stamp_ns = pose.stamp_ns
            if self.stale_row < STALE_ROW:
                return PoseReason.STALE
            buffer.clear()
        self.stale_row, self.stale_stamp_ns = 0, -1
        if buffer.insert(pose) is None:
            return PoseReason.DUPLICATE
        buffer.trim()
        return None
