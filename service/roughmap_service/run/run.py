"""A run: what each message, decision and event does to the map, the same live, in a replay and after a restart.

The way of a cloud, live:

    taken = run.take(robot, content, identity, arrival)     # it is in the log; it waits in the inbox for its poses
    proposal = run.decide(now)                              # the next cloud that can be decided, and by which poses
    change = run.place(proposal)                            # its points are placed, its tiles are in memory
    event = change()                                        # the map has changed; the event goes into the log

A replay takes the same messages, and `follow` does what the logged events say. There is no thread, network, disk or
clock in here, so nothing but the order of the calls decides what comes out.
"""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field

from roughmap import Prepared, RoughMap, TooManyTiles
from roughmap.tiles.table import ReaderLock
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
)
from roughmap_schemas.faults import ReportedError
from roughmap_service.run.decoding import Content
from roughmap_service.run.duplicates import Duplicates, Identity
from roughmap_service.run.inbox import INTEGRATED, Arrival, Inbox, LoggedCloud, Proposal
from roughmap_service.run.placing import place_cloud
from roughmap_service.run.poses import NoTrajectory, Pose, PoseBuffer
from roughmap_service.run.settings import Settings

KNOWN_WHEN_PLACED = (INTEGRATED, CloudReason.EMPTY, CloudReason.TOO_MANY_TILES)
"""Outcomes that follow from placing the cloud. All others are known before."""


REPLAYED = Arrival(0.0)
"""The arrival of a replayed message: it waits for nothing."""


class RunError(ReportedError):
    """The log contradicts itself: an event names something that the log does not hold."""


@dataclass(frozen=True, slots=True)
class Taken:
    """What a message did to the run.

    ``input`` is its number, ``rejected`` why an odometry or transform gives no pose. ``clock_reset``: the robot's clock
    was set back. ``jumped``: its transform moved further than the sigmas of its poses allow.
    """

    input: int
    rejected: PoseReason | None = None
    clock_reset: bool = False
    jumped: bool = False


@dataclass
class Run:
    """A run up to its last record: the map, and what later messages still depend on.

    Attributes:
        input: number of the last message; the log's numbers begin at 1.
        record: number of the last record, messages and events together.
        clouds: logged clouds without a decision, by input number.
        newest_stamp_ns: of the points in the map.
    """

    settings: Settings
    map: RoughMap
    epoch: int = 0
    input: int = 0
    record: int = 0
    newest_stamp_ns: int = 0
    poses: dict[str, PoseBuffer] = field(default_factory=dict)
    clouds: dict[int, LoggedCloud] = field(default_factory=dict)
    duplicates: Duplicates = field(init=False)
    inbox: Inbox = field(init=False)

    def __post_init__(self) -> None:
        self.duplicates = Duplicates(self.settings.config.input.duplicates)
        self.inbox = Inbox(self.settings, self.poses)

    def take(self, robot: str, content: Content, identity: Identity, arrival: Arrival | None = None) -> Taken:
        """Number the next message and apply it.

        With an ``arrival`` a cloud waits in the inbox. A replayed one has none: its event holds what was decided.
        """
        self.input += 1
        self.record += 1
        self.duplicates.add(identity, self.input)
        if isinstance(content, Cloud):
            cloud = self.keep(self.input, robot, content, arrival or REPLAYED)
            if arrival is not None:
                self.inbox.feed(cloud)
            return Taken(self.input)
        buffer = self.buffer(robot)
        if isinstance(content, Odometry):
            rejected, clock_reset = buffer.add(content, self.input)
            if clock_reset:
                self.inbox.clock_reset(robot)
            return Taken(self.input, rejected, clock_reset)
        jumps = buffer.jumps
        rejected = buffer.add_transform(content, self.input)
        return Taken(self.input, rejected, jumped=buffer.jumps > jumps)

    def keep(self, number: int, robot: str, content: Cloud, arrival: Arrival = REPLAYED) -> LoggedCloud:
        """Keep a logged cloud until its event."""
        cloud = self.clouds[number] = LoggedCloud.of(number, robot, content, arrival)
        return cloud

    def resume(self, now: float) -> None:
        """Continue live after a replay: undecided clouds wait again, from monotonic time ``now`` (s) on."""
        for number, cloud in sorted(self.clouds.items()):
            self.inbox.feed(self.keep(number, cloud.robot, cloud.cloud, Arrival(now, promised=True, resumed=True)))

    def decide(self, now: float) -> Proposal | None:
        """Take the next cloud that can be decided at monotonic time ``now`` (s) out of the inbox; None if none can."""
        return self.inbox.tick(now)

    def place(
        self, proposal: Proposal, reader_lock: ReaderLock = nullcontext, *, no_new_tiles: bool = False
    ) -> Callable[[], IntegrationEvent]:
        """Do the part of an integration that readers can't see. Return a function that changes the map; call it next.

        The points are placed and the tiles they touch brought into memory; for ``reader_lock`` see
        `RoughMap.prepare_points`. With ``no_new_tiles`` there is no memory for more tiles, and a cloud that needs one
        ends as `too_many_tiles`.
        """
        cloud, outcome, prepared = proposal.cloud, proposal.outcome, Prepared(0, {})
        if outcome in KNOWN_WHEN_PLACED:
            # No replay can know whether there was room, but it can know that the cloud needed a new tile.
            no_new_tiles = no_new_tiles or outcome == CloudReason.TOO_MANY_TILES
            poses = self._named_poses(proposal)
            try:
                prepared = place_cloud(
                    self.map,
                    cloud.robot,
                    cloud.cloud,
                    poses,
                    self.settings,
                    no_new_tiles=no_new_tiles,
                    reader_lock=reader_lock,
                )
                outcome = INTEGRATED if prepared.accepted else CloudReason.EMPTY
            except TooManyTiles:
                outcome = CloudReason.TOO_MANY_TILES
            except NoTrajectory as error:
                raise RunError(
                    f"the poses of {cloud.robot} for input {cloud.input} are not a trajectory: {error}"
                ) from None

        def change() -> IntegrationEvent:
            self.map.integrate(prepared)
            del self.clouds[cloud.input]  # with the map held: readers that see no cloud waiting see all of them mapped
            if prepared.accepted:
                self.newest_stamp_ns = max(self.newest_stamp_ns, cloud.last_ns)
            return IntegrationEvent(
                epoch=self.epoch,
                input=cloud.input,
                robot=cloud.robot,
                poses=list(proposal.poses),
                outcome=outcome,
                accepted=prepared.accepted,
                rejected={PointReason(name): n for name, n in prepared.rejected.items()},
                sequence=self.map.sequence,
            )

        return change

    def next_reset(self) -> ResetEvent:
        """Return the event of a reset, before it is carried out."""
        return ResetEvent(epoch=self.epoch + 1, sequence=self.map.sequence + 1)

    def reset(self) -> ResetEvent:
        """Empty the map; a new epoch begins."""
        self.map.reset()
        self.epoch += 1
        self.newest_stamp_ns = 0
        return ResetEvent(epoch=self.epoch, sequence=self.map.sequence)

    def checkpoint(self) -> CheckpointEvent:
        """Return the map's digest at its current sequence."""
        return CheckpointEvent(epoch=self.epoch, sequence=self.map.sequence, digest=self.map.digest())

    def follow(self, event: Event) -> Event:
        """Apply a logged event. Return the event that results, which should equal the logged one.

        RunError if it names a message that the run does not have.
        """
        self.record += 1
        if isinstance(event, IntegrationEvent):
            cloud = self.clouds.get(event.input)
            if cloud is None:
                raise RunError(f"an event names input {event.input}, which is not an undecided cloud of this log")
            if event.robot != cloud.robot:
                raise RunError(
                    f"an event names input {event.input} of {event.robot}, which is a cloud of {cloud.robot}"
                )
            return self.place(Proposal(cloud, event.outcome, tuple(event.poses)))()
        return self.reset() if isinstance(event, ResetEvent) else self.checkpoint()

    def use(self, settings: Settings) -> None:
        """Continue under other settings, such as those of the log's next file."""
        self.settings = self.inbox.settings = settings
        for buffer in self.poses.values():
            buffer.history_ns = settings.history_ns
            buffer.jump_m, buffer.jump_rad = settings.jump_m, settings.jump_rad
            buffer.max_poses, buffer.max_transforms = settings.max_poses, settings.max_transforms

    def buffer(self, robot: str) -> PoseBuffer:
        """Return the robot's pose buffer, made when it is first needed."""
        if robot not in self.poses:
            s = self.settings
            self.poses[robot] = PoseBuffer(
                s.frame_id, s.history_ns, s.jump_m, s.jump_rad, s.max_poses, s.max_transforms
            )
        return self.poses[robot]

    def _named_poses(self, proposal: Proposal) -> list[Pose]:
        cloud = proposal.cloud
        try:
            return self.buffer(cloud.robot).named(proposal.poses)
        except KeyError as missing:
            raise RunError(
                f"the event of input {cloud.input} names odometry and transform {missing}, which are not among the "
                f"poses of {cloud.robot} at that place of the log"
            ) from None
