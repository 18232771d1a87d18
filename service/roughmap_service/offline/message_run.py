"""A robot's recorded messages into a map, decided as a service would: the clock is when each message was recorded."""

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from roughmap import RoughMap
from roughmap_schemas import Cloud, Config, IntegrationEvent, MessageFault, Odometry, Refusal, SensorConfig
from roughmap_schemas.kinds import Kind, RobotMessage
from roughmap_service.formats.recorded import CloudFileFault, Contents
from roughmap_service.run.decoding import Content, decode
from roughmap_service.run.duplicates import Duplicates
from roughmap_service.run.inbox import INTEGRATED, Arrival
from roughmap_service.run.odometry_clock import Verdict
from roughmap_service.run.run import NoTimes, Run
from roughmap_service.run.settings import Settings

EVER = float("inf")

TAKEN = "taken"
"""The outcome of a pose that was not dropped."""


@dataclass
class Counts:
    """What became of messages: clouds and poses by outcome, points, and messages that were refused, by reason."""

    clouds: Counter[str] = field(default_factory=Counter)
    poses: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    rejected: Counter[str] = field(default_factory=Counter)
    points: int = 0
    decided: int = 0
    """Points of the clouds that are decided."""
    lost: str = ""
    """The last refusal of a cloud, in words."""


class MessageRun:
    """Takes the messages of recordings, one robot's, in order. `config` changes with what the recordings hold.

    With a `range_sigma` (m), sensors that are not configured have that noise. Their extrinsics come from transforms, or
    they are at the pose itself.
    """

    def __init__(self, rough_map: RoughMap, config: Config, robot: str, range_sigma: float | None) -> None:
        self.config = config
        self.counts = Counts()
        self.sensors: set[str] = set()
        self._map = rough_map
        self._robot = robot
        self._range_sigma = range_sigma
        self._begun = False
        self._run = Run(Settings(config), rough_map)
        self._first = False
        self._begun_ns: int | None = None
        self._last_ns = 0
        self._now = 0.0

    def begin(self, contents: Contents, name: str) -> None:
        """Begin the next recording. CloudFileFault if its poses are in another frame than those before."""
        frame = self.config.map.frame_id
        if contents.map_frame != frame:
            if self._begun:
                raise CloudFileFault(f"{name}: its poses are in {contents.map_frame!r}, those before in {frame!r}")
            own = self.config.map.model_copy(update={"frame_id": contents.map_frame})
            self._use(self.config.model_copy(update={"map": own}))
        self._begun = self._first = True
        for frame_id in sorted(contents.mounted | contents.placed):
            self._know(frame_id, by_transform=frame_id in contents.mounted)

    def take(self, message: RobotMessage) -> None:
        """Take the next message and decide the clouds that can be decided then."""
        if self._first and message.log_ns < self._last_ns:  # another drive: nothing of the last one explains it
            self.end()
            self._run, self._begun_ns = Run(self._run.settings, self._map), None
        if self._begun_ns is None:
            self._begun_ns = self._last_ns = message.log_ns
        self._first = False
        self._last_ns = max(self._last_ns, message.log_ns)
        self._now = (self._last_ns - self._begun_ns) * 1e-9
        run, payload = self._run, message.payload
        identity = Duplicates.identity(self._robot, message.kind, payload)
        try:
            if run.duplicates.find(identity) is not None:
                raise MessageFault(Refusal.DUPLICATE, "it came before")
            content = self._admit(message.kind, payload)
        except MessageFault as fault:
            self.counts.refused[str(fault.code)] += 1
            if message.kind is Kind.POINTS:
                self.counts.lost = str(fault)
            return
        if isinstance(content, Odometry):
            self._decide_before(content)
        elif isinstance(content, Cloud):
            self.counts.points += len(content.points)
        taken = run.take(self._robot, content, identity, message.log_ns, Arrival(self._now))
        if taken.odometry is not None:
            self.counts.poses.update(TAKEN if reason is None else str(reason) for reason in taken.odometry.settled)
        elif taken.rejected is not None:
            self.counts.poses[str(taken.rejected)] += 1
        while self._decide():
            pass

    def end(self) -> None:
        """Decide the clouds that still wait: nothing comes that they could wait for."""
        self._now = EVER
        while self._decide():
            pass

    def _admit(self, kind: Kind, payload: bytes) -> Content:
        content = decode(kind, payload, self._run.settings)
        of_sensor = isinstance(content, Cloud) and content.frame_id != self.config.map.frame_id
        if content.stamp_ns == 0 and (isinstance(content, Odometry) or of_sensor):
            raise MessageFault(Refusal.UNSET_STAMP, "its stamp is 0, which means not set")
        if isinstance(content, Cloud) and of_sensor:
            if self._run.settings.sensor(self._robot, content.frame_id) is None:
                raise MessageFault(Refusal.UNKNOWN_SENSOR, f"[sensors.{content.frame_id}] is not configured")
            self.sensors.add(content.frame_id)
        return content

    def _know(self, frame_id: str, *, by_transform: bool) -> None:
        """Configure a sensor that is not, if its noise is known."""
        if self._range_sigma is None or self.config.sensor(self._robot, frame_id) is not None:
            return
        sensor = SensorConfig(range_sigma=self._range_sigma, extrinsics="transform" if by_transform else "configured")
        self._use(self.config.model_copy(update={"sensors": {**self.config.sensors, frame_id: sensor}}))

    def _use(self, config: Config) -> None:
        self.config = config
        self._run.use(Settings(config))

    def _decide_before(self, odometry: Odometry) -> None:
        """Decide the clouds that have their poses but would lose them by this pose."""
        run = self._run
        verdict = run.robot(self._robot).judge(odometry.stamp_ns)
        if verdict in (Verdict.HOLD, Verdict.REPEAT):
            return
        horizon = np.inf if verdict.begins_anew else odometry.stamp_ns - run.settings.history_ns
        while run.inbox.holds_before(self._robot, horizon) and self._decide():
            pass

    def _decide(self) -> bool:
        """Decide one cloud; False if none can be decided now."""
        run = self._run
        for found in run.find_times(self._now):
            if not isinstance(found, NoTimes):
                run.read_times(found)
        proposal = run.decide(self._now)
        if proposal is None:
            return False
        self._count(run.place(proposal)(), len(proposal.cloud.cloud.points))
        return True

    def _count(self, event: IntegrationEvent, points: int) -> None:
        self.counts.clouds[str(event.outcome)] += 1
        self.counts.decided += points
        self.counts.rejected.update({str(reason): number for reason, number in event.rejected.items()})
        placed = event.accepted + sum(event.rejected.values())
        if event.outcome != INTEGRATED and placed < points:
            self.counts.rejected[str(event.outcome)] += points - placed
