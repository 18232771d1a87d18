"""A run: what each message, decision and event does to the map, the same live, in a replay and after a restart.

The way of a cloud, live:

    run.take(robot, content, identity, received_ns, arrival)  # it is in the log; it waits in the inbox for its poses
    for found in run.find_times(now):                         # clouds of a new sensor wait until their times are clear;
        run.read_times(found)                                 # the event that says so goes into the log
    proposal = run.decide(now)                                # the next cloud that can be decided, and by which poses
    change = run.place(proposal)                              # its points are placed, its tiles are in memory
    event = change()                                          # the map has changed; the event goes into the log

A replay takes the same messages, and `follow` does what the logged events say. There is no thread, network, disk or
clock in here, so nothing but the order of the calls decides what comes out.
"""

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field, replace

import numpy as np

from roughmap import Prepared, RoughMap, TooManyTiles
from roughmap.arrays import I4
from roughmap.tiles.table import ReaderLock
from roughmap_schemas import (
    CheckpointEvent,
    Cloud,
    CloudReason,
    Event,
    ForgetEvent,
    IntegrationEvent,
    Odometry,
    PointReason,
    PoseReason,
    ResetEvent,
    SensorTimeEvent,
    TimeForm,
)
from roughmap_schemas.faults import ReportedError
from roughmap_service.run.decoding import Content
from roughmap_service.run.duplicates import Duplicates, Identity
from roughmap_service.run.inbox import INTEGRATED, Arrival, Inbox, LoggedCloud, Proposal
from roughmap_service.run.mountings import Mounted
from roughmap_service.run.placing import place_cloud
from roughmap_service.run.point_times import Ambiguous
from roughmap_service.run.poses import NoTrajectory, Pose
from roughmap_service.run.robot import OdometryTaken, Robot
from roughmap_service.run.sensor_clock import Doubt, SensorClock
from roughmap_service.run.sensor_times import Reading, SensorTimes
from roughmap_service.run.settings import Settings, time_offset_ns

KNOWN_WHEN_PLACED = (INTEGRATED, CloudReason.EMPTY, CloudReason.TOO_MANY_TILES)
"""Outcomes that follow from placing the cloud. All others are known before."""


REPLAYED = Arrival(0.0)
"""The arrival of a replayed message: it waits for nothing."""


UNTIMED = Doubt(CloudReason.TIME_FORM)


class RunError(ReportedError):
    """The log contradicts itself: an event names something that the log does not hold."""


@dataclass(frozen=True, slots=True)
class Taken:
    """What a message did to the run.

    ``input`` is its number, ``odometry`` what an odometry led to, ``rejected`` why a transform is not taken.
    ``jumped``: its transform moved further than the sigmas of its poses allow. ``mounted``: the mounting of a sensor
    that came with a transform.
    """

    input: int
    odometry: OdometryTaken | None = None
    rejected: PoseReason | None = None
    jumped: bool = False
    mounted: Mounted | None = None


@dataclass(frozen=True, slots=True)
class NoTimes:
    """Clouds of a sensor end since the meaning of their points' times is unclear; ``seen`` says what was seen."""

    robot: str
    frame_id: str
    seen: str


@dataclass
class Run:
    """A run up to its last record: the map, and what later messages still depend on.

    Attributes:
        input: number of the last message; the log's numbers begin at 1.
        record: number of the last record, messages and events together.
        clouds: logged clouds without a decision, by input number.
        doubts: what is wrong with the stamps of those in doubt.
        times: how the times of the sensors' points are read.
        readings: how those of a cut's undecided clouds were, until the clouds are read from the log again.
        newest_stamp_ns: of the points in the map.
    """

    settings: Settings
    map: RoughMap
    epoch: int = 0
    input: int = 0
    record: int = 0
    newest_stamp_ns: int = 0
    robots: dict[str, Robot] = field(default_factory=dict)
    clouds: dict[int, LoggedCloud] = field(default_factory=dict)
    doubts: dict[int, Doubt] = field(default_factory=dict)
    times: SensorTimes = field(default_factory=SensorTimes)
    readings: dict[int, Reading | None] = field(default_factory=dict)
    duplicates: Duplicates = field(init=False)
    inbox: Inbox = field(init=False)

    def __post_init__(self) -> None:
        self.duplicates = Duplicates(self.settings.config.input.duplicates)
        self.inbox = Inbox(self.settings, self.robots, self.doubts)

    def take(
        self, robot: str, content: Content, identity: Identity, received_ns: int, arrival: Arrival | None = None
    ) -> Taken:
        """Number the next message and apply it; ``received_ns`` is its log time, the same in a replay.

        With an ``arrival`` a cloud waits in the inbox. A replayed one has none: its event holds what was decided.
        """
        self.input += 1
        self.record += 1
        self.duplicates.add(identity, self.input)
        if isinstance(content, Cloud):
            self.times.count(robot, content, self.settings)
            cloud = self.keep(self.input, robot, content, arrival or REPLAYED)
            self._judge_stamp(cloud, content.stamp_ns, received_ns)
            if arrival is not None:
                self.inbox.feed(cloud)
            return Taken(self.input)
        if isinstance(content, Odometry):
            taken = self.robot(robot).take_odometry(content, self.input, received_ns)
            if taken.ended_from:
                self._end_clouds(robot, taken.ended_from)
            return Taken(self.input, taken)
        mounted = self.robot(robot).mount(content)
        if mounted is not None:
            return Taken(self.input, mounted=mounted)
        rejected, jumped = self.robot(robot).add_transform(content, self.input)
        return Taken(self.input, rejected=rejected, jumped=jumped)

    def keep(self, number: int, robot: str, content: Cloud, arrival: Arrival = REPLAYED) -> LoggedCloud:
        """Keep a logged cloud until its event."""
        reading = self.times.reading(robot, content, self.settings)
        cloud = self.clouds[number] = LoggedCloud.of(number, robot, content, reading, arrival)
        return cloud

    def keep_again(self, number: int, robot: str, content: Cloud) -> None:
        """Keep a cloud that was undecided at a store's cut; its points' times are read as they were then.

        Since it came, the sensor's form or settings may have changed.
        """
        if number in self.readings:
            self.clouds[number] = LoggedCloud.of(number, robot, content, self.readings.pop(number), REPLAYED)
        else:
            self.keep(number, robot, content)  # decided, or of a version without forms

    def resume(self, now: float) -> None:
        """Continue live after a replay: undecided clouds wait again, from monotonic time ``now`` (s) on."""
        for number, cloud in sorted(self.clouds.items()):
            self.clouds[number] = replace(cloud, arrival=Arrival(now, promised=True, resumed=True))
            self.inbox.feed(self.clouds[number])

    def find_times(self, now: float) -> Iterator[SensorTimeEvent | NoTimes]:
        """Find how the times of waiting clouds are read, at monotonic time ``now`` (s).

        Log each event and give it to `read_times` before the next. Clouds whose times are unclear end as `time_form`.
        """
        for clouds, due in self.inbox.untimed(now):
            robot, frame_id = sensor = clouds[0].sensor
            found = self.times.find(sensor, [one.cloud for one in clouds], self.settings, last=due)
            if isinstance(found, Ambiguous):
                for one in clouds:
                    known = self.doubts.get(one.input)
                    if known is None or known.reason is None:
                        self.doubts[one.input] = UNTIMED
                yield NoTimes(robot, frame_id, found.seen)
            elif found is not None:
                yield SensorTimeEvent(
                    epoch=self.epoch, robot=robot, frame_id=frame_id, field=found.field, unit=found.unit,
                    origin=found.origin, sequence=self.map.sequence,
                )  # fmt: skip

    def read_times(self, event: SensorTimeEvent) -> SensorTimeEvent:
        """Read the times of a sensor's points in this form from now on, and those of its waiting clouds."""
        sensor = event.robot, event.frame_id
        self.times.take(sensor, TimeForm(event.field, event.unit, event.origin), self.settings)

        def with_times(cloud: LoggedCloud) -> LoggedCloud:
            reading = None if cloud.timed else self.times.reading(cloud.robot, cloud.cloud, self.settings)
            return cloud if reading is None else cloud.with_times(reading)

        for number, cloud in self.clouds.items():
            if cloud.sensor == sensor:
                self.clouds[number] = with_times(cloud)
        if sensor in self.inbox.queues:
            self.inbox.queues[sensor].replace(lambda cloud: self.clouds[cloud.input])
        return event.model_copy(update={"epoch": self.epoch, "sequence": self.map.sequence})

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
        clearing = mounting = None
        if outcome in KNOWN_WHEN_PLACED and self.settings.by_transform(*cloud.sensor):
            mounting = self.robot(cloud.robot).mounting(cloud.cloud.frame_id)
            if mounting is None:  # only under other settings than those of the event
                outcome = CloudReason.NO_EXTRINSICS
        if outcome in KNOWN_WHEN_PLACED:
            # No replay can know whether there was room, but it can know that the cloud needed a new tile.
            no_new_tiles = no_new_tiles or outcome == CloudReason.TOO_MANY_TILES
            poses = self._named_poses(proposal)
            clearing = self._clearing_sensor(cloud)
            try:
                prepared = place_cloud(
                    self.map,
                    cloud.robot,
                    cloud.cloud,
                    poses,
                    self.settings,
                    mounting=mounting,
                    clear=clearing is not None,
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
            report = self.map.integrate(prepared)
            del self.clouds[cloud.input]  # with the map held: readers that see no cloud waiting see all of them mapped
            self.doubts.pop(cloud.input, None)
            if prepared.accepted:
                self._count_integrated(cloud)
                self.newest_stamp_ns = max(self.newest_stamp_ns, cloud.last_ns)
                if clearing is not None:
                    clearing.cleared_ns = cloud.cloud.stamp_ns
            return IntegrationEvent(
                epoch=self.epoch,
                input=cloud.input,
                robot=cloud.robot,
                poses=list(proposal.poses),
                outcome=outcome,
                accepted=prepared.accepted,
                rejected={PointReason(name): n for name, n in prepared.rejected.items()},
                sequence=self.map.sequence,
                cleared=report.cleared,
            )

        return change

    def next_reset(self) -> ResetEvent:
        """Return the event of a reset, before it is carried out."""
        return ResetEvent(epoch=self.epoch + 1, sequence=self.map.sequence + 1)

    def reset(self) -> ResetEvent:
        """Empty the map; a new epoch begins, into which the messages so far may be sent again."""
        self.map.reset()
        if self.settings.rules > 1:
            self.duplicates.clear()
            for robot in self.robots.values():
                robot.begin_map(self.input + 1)
        self.epoch += 1
        self.newest_stamp_ns = 0
        return ResetEvent(epoch=self.epoch, sequence=self.map.sequence)

    def forget(self, tiles: I4) -> ForgetEvent:
        """Erase (T, 2) level-0 tiles, ascending. RunError if the map lacks one of them."""
        if self.map.forget(tiles) != len(tiles):
            raise RunError("an event forgets tiles that the map does not have")
        return ForgetEvent(epoch=self.epoch, sequence=self.map.sequence, tiles=tiles.tolist())

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
        if isinstance(event, SensorTimeEvent):
            return self.read_times(event)
        if isinstance(event, ForgetEvent):
            try:
                return self.forget(np.array(event.tiles, np.int32))
            except OverflowError:
                raise RunError("an event forgets tiles beyond all maps") from None
        return self.reset() if isinstance(event, ResetEvent) else self.checkpoint()

    def use(self, settings: Settings) -> None:
        """Continue under other settings, such as those of the log's next file."""
        self.settings = self.inbox.settings = settings
        for robot in self.robots.values():
            robot.use(settings)

    def robot(self, name: str) -> Robot:
        """Return the state of a robot, made when it is first needed."""
        if name not in self.robots:
            self.robots[name] = Robot(self.settings, name)
        return self.robots[name]

    def _judge_stamp(self, cloud: LoggedCloud, stamp_ns: int, received_ns: int) -> None:
        """Note what is wrong with a new cloud's stamp."""
        if self.settings.rules == 1 or cloud.cloud.frame_id == self.settings.frame_id:
            return
        robot, config = self.robot(cloud.robot), self.settings.config.sensor(*cloud.sensor)
        offset_ns = 0 if config is None else time_offset_ns(config)
        sensor = robot.sensors.setdefault(cloud.cloud.frame_id, SensorClock())
        doubt = sensor.cloud(cloud.input, stamp_ns + offset_ns, received_ns, robot.clock)
        if doubt is not None:
            self.doubts[cloud.input] = doubt

    def _end_clouds(self, name: str, number: int) -> None:
        """End a robot's clouds as `clock_reset`: its clock went back at this input.

        Of the clouds since, only those after their sensor's stamps fell back too are of the present clock.
        """
        sensors = self.robots[name].sensors
        for cloud in self.clouds.values():
            if cloud.robot != name or cloud.input < number or cloud.cloud.frame_id not in sensors:
                continue
            if cloud.input >= sensors[cloud.cloud.frame_id].fell >= number:
                self.doubts.pop(cloud.input, None)
            else:
                self.doubts[cloud.input] = Doubt(CloudReason.CLOCK_RESET)

    def _clearing_sensor(self, cloud: LoggedCloud) -> SensorClock | None:
        """Return the sensor whose scan it is if the scan clears what it sees through, else None."""
        robot = self.robots.get(cloud.robot)
        sensor = None if robot is None else robot.sensors.get(cloud.cloud.frame_id)
        if sensor is None or not self.settings.clears:
            return None
        return sensor if sensor.clears(cloud.cloud.stamp_ns, self.settings.clear_interval_ns) else None

    def _count_integrated(self, cloud: LoggedCloud) -> None:
        sensor = self.robots[cloud.robot].sensors.get(cloud.cloud.frame_id) if cloud.robot in self.robots else None
        if sensor is not None:
            sensor.count_integrated()

    def _named_poses(self, proposal: Proposal) -> list[Pose]:
        cloud = proposal.cloud
        try:
            return self.robot(cloud.robot).buffer.named(proposal.poses)
        except KeyError as missing:
            raise RunError(
                f"the event of input {cloud.input} names odometry and transform {missing}, which are not among the "
                f"poses of {cloud.robot} at that place of the log"
            ) from None
