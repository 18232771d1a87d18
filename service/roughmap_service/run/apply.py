"""The only writer of the map: what an event does, the same live, in a replay and in recovery."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field

from roughmap import RoughMap, Scan, TooManyTiles
from roughmap.cell import OFFSET_LIMIT_NS, STAMP_LIMIT_NS
from roughmap.integration.integrate import Prepared
from roughmap.tiles.table import Hold
from roughmap_schemas import (
    CheckpointEvent,
    Cloud,
    CloudReason,
    Event,
    IntegrationEvent,
    Odometry,
    PointReason,
    PoseReason,
    ResetEvent,
    Transform,
)
from roughmap_schemas.faults import ReportedError
from roughmap_service.run.inbox import INTEGRATED
from roughmap_service.run.poses import Pose, PoseBuffer, trajectory
from roughmap_service.run.settings import Settings

PLACED = (INTEGRATED, CloudReason.EMPTY, CloudReason.TOO_MANY_TILES)
"""Outcomes that only placing the cloud tells; all others are known before."""


class RunError(ReportedError):
    """A log that does not hold what its events name."""


@dataclass
class RunState:
    """A run at one place of its log: the map, and what of the inputs still bears on it.

    Everything here follows from the log's records in their order; no clock and no timer has a part in it.
    """

    settings: Settings
    map: RoughMap
    epoch: int = 0
    input: int = 0
    record: int = 0
    poses: dict[str, PoseBuffer] = field(default_factory=dict)
    clouds: dict[int, Cloud] = field(default_factory=dict)
    no_new_tiles: bool = False
    """Set where the memory has no room for more: a cloud that needs a new tile is then one of too many."""

    def take_cloud(self, number: int, cloud: Cloud) -> None:
        """A cloud was logged; it stays until its event."""
        self.clouds[number] = cloud

    def take_odometry(self, number: int, robot: str, odometry: Odometry) -> tuple[PoseReason | None, bool]:
        """An odometry was logged: see `PoseBuffer.add`."""
        return self.buffer(robot).add(odometry, number)

    def take_transform(self, number: int, robot: str, transform: Transform) -> PoseReason | None:
        """A transform was logged: see `PoseBuffer.add_transform`."""
        return self.buffer(robot).add_transform(transform, number)

    def use(self, settings: Settings) -> None:
        """Go on under other settings, as a new file of the log says."""
        self.settings = settings
        for buffer in self.poses.values():
            buffer.history_ns = settings.history_ns
            buffer.jump_m, buffer.jump_rad = settings.jump_m, settings.jump_rad

    def apply(self, event: Event) -> Event:
        """Do what the event says and return it as it came out.

        Live, the event is a proposal, and what is returned is logged. In a replay it is the logged event, and what is
        returned must equal it. RunError if it names an input that is not there.
        """
        if isinstance(event, IntegrationEvent):
            return self.prepare(event)()
        if isinstance(event, ResetEvent):
            self.map.reset()
            self.epoch += 1
            return ResetEvent(epoch=self.epoch, sequence=self.map.sequence)
        return CheckpointEvent(epoch=self.epoch, sequence=self.map.sequence, digest=self.map.digest())

    def prepare(self, event: IntegrationEvent, hold: Hold = nullcontext) -> Callable[[], IntegrationEvent]:
        """All of an integration before the change that readers see; what is returned makes that change, and comes next.

        The points are placed, and the tiles that they touch brought into memory: for ``hold`` see `RoughMap.prepare`.
        """
        cloud = self.clouds.get(event.input)
        if cloud is None:
            raise RunError(f"an event names input {event.input}, which is no undecided cloud of this log")
        outcome: str = event.outcome
        prepared = Prepared(0, {})
        if event.outcome in PLACED:
            try:
                poses = self.buffer(event.robot).named(event.poses)
            except KeyError as missing:
                raise RunError(
                    f"the event of input {event.input} names odometry and transform {missing}, which are not among the "
                    f"poses of {event.robot} at that place of the log"
                ) from None
            try:
                # Whether there was room then, no replay can know: that the cloud needed a new tile, it can.
                bounded = self.no_new_tiles or event.outcome == CloudReason.TOO_MANY_TILES
                prepared = prepare(self.map, event.robot, cloud, poses, self.settings, no_new_tiles=bounded, hold=hold)
                outcome = INTEGRATED if prepared.accepted else CloudReason.EMPTY
            except TooManyTiles:
                outcome = CloudReason.TOO_MANY_TILES

        def change() -> IntegrationEvent:
            self.map.integrate(prepared)
            del self.clouds[event.input]  # here, with the map held: who sees none waiting sees a map with all of them
            return event.model_copy(
                update={
                    "epoch": self.epoch,
                    "outcome": outcome,
                    "accepted": prepared.accepted,
                    "rejected": {PointReason(name): n for name, n in prepared.rejected.items()},
                    "sequence": self.map.sequence,
                }
            )

        return change

    def buffer(self, robot: str) -> PoseBuffer:
        """The robot's pose buffer, made when it is first heard."""
        if robot not in self.poses:
            s = self.settings
            self.poses[robot] = PoseBuffer(s.frame_id, s.history_ns, s.jump_m, s.jump_rad)
        return self.poses[robot]


def prepare(
    rough_map: RoughMap,
    robot: str,
    cloud: Cloud,
    poses: Sequence[Pose],
    settings: Settings,
    *,
    no_new_tiles: bool = False,
    hold: Hold = nullcontext,
) -> Prepared:
    """Place a cloud, for the map to integrate. TooManyTiles if it can't."""
    most_new, most = 0 if no_new_tiles else settings.max_new_tiles, settings.max_tiles
    if cloud.frame_id == settings.frame_id:  # no pose, no limits of a sensor, one covariance for all its points
        return rough_map.prepare(
            cloud.points, settings.placed_covariance, cloud.stamp_ns, offsets_ns=cloud.offsets_ns,
            max_new_tiles=most_new, max_tiles=most, hold=hold,
        )  # fmt: skip
    sensor = settings.sensor(robot, cloud.frame_id)
    if sensor is None:
        # It waited over a restart with a configuration that no longer has its sensor: nobody knows where that sat.
        return Prepared(0, {PointReason.NO_POSE: len(cloud.points)} if len(cloud.points) else {})
    scan = Scan(
        cloud.points,
        cloud.stamp_ns,
        offsets_ns=cloud.offsets_ns,
        translation=sensor.translation,
        rotation=sensor.rotation,
    )
    try:
        line = trajectory(poses, settings.pose_covariance)
    except ValueError as error:
        raise RunError(f"an event names poses of {robot} that make no way: {error}") from None
    return rough_map.prepare_scan(
        scan, line, sensor.noise, sensor.limits, max_new_tiles=most_new, max_tiles=most, hold=hold
    )


def span(cloud: Cloud) -> tuple[int, int]:
    """First and last time of a cloud's points in ns, without those whose own time is off; its stamp if none is left."""
    if cloud.offsets_ns is None or not len(cloud.offsets_ns):
        return cloud.stamp_ns, cloud.stamp_ns
    offsets = cloud.offsets_ns
    last = min(OFFSET_LIMIT_NS, STAMP_LIMIT_NS - 1 - cloud.stamp_ns)
    if int(offsets.min()) < 0 or int(offsets.max()) > last:
        offsets = offsets[(offsets >= 0) & (offsets <= last)]
        if not len(offsets):
            return cloud.stamp_ns, cloud.stamp_ns
    return cloud.stamp_ns + int(offsets.min()), cloud.stamp_ns + int(offsets.max())
