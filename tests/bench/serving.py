"""A real service for the benchmark: its process, sessions with it, and what is sent to it."""

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import zenoh
from figures import Bench
from roughmap_commands import ServiceProcess
from scans import NOISE, POSE_VARIANCE, START_NS, SWEEP_NS, Recording

from roughmap_schemas.cloud import encode_cloud
from roughmap_schemas.odometry import encode_odometry

MAP, ROBOT, SENSOR = "bench", "rover", "lidar"
LEVEL = (0.0, 0.0, 0.0, 1.0)
WAIT_S = 60.0
"""How long anything may take that ought to happen at once."""


def configuration(folder: Path, more: str = "") -> Path:
    """A service's settings: log on, all else by default but for ``more`` (TOML of further sections).

    A pose that a busy machine holds up is waited for: it shall be seen in the latency, and not cost a scan.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "roughmap.toml"
    path.write_text(
        f'[map]\nname = "{MAP}"\n[zenoh]\nlisten = ["tcp/127.0.0.1:0"]\nshared_memory = true\n'
        f'[log]\ndirectory = "{folder / "log"}"\n'
        f'[http]\nlisten = ""\n[input]\nmax_wait = 10.0\n'
        f"[sensors.{SENSOR}]\nrange_sigma = {NOISE.range_sigma}\nbeam_sigma = {NOISE.beam_sigma}\n{more}"
    )
    return path


@contextmanager
def served(folder: Path, more: str = "") -> Iterator[ServiceProcess]:
    """A service, once it is ready; in the end it is stopped in order."""
    with ServiceProcess(configuration(folder, more), folder / "serve.txt") as service:
        yield service
        service.stop()


def open_session(endpoints: list[str], *, shared_memory: bool = True) -> zenoh.Session:
    """A session with those at ``endpoints`` and nobody else."""
    config = zenoh.Config()
    for path, value in {
        "mode": "client",
        "scouting/multicast/enabled": False,
        "connect/endpoints": endpoints,
        "transport/shared_memory/enabled": shared_memory,
    }.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


class Decided:
    """What the service says of clouds, as it comes: one event a cloud, in order."""

    def __init__(self, session: zenoh.Session) -> None:
        self.times: list[float] = []
        self._other: list[str] = []
        self._changed = threading.Condition()
        self._subscriber = session.declare_subscriber(f"maps/{MAP}/events", self._take)
        # An answer shows that the service has heard of what was declared before the question.
        replies = session.get(f"maps/{MAP}/status", timeout=WAIT_S)
        if not any(reply.ok is not None for reply in replies):
            raise RuntimeError("the service does not tell its status")

    def _take(self, sample: zenoh.Sample) -> None:
        now = time.perf_counter()
        event = json.loads(sample.payload.to_bytes())
        if event["kind"] != "integration":
            return
        with self._changed:
            self.times.append(now)
            if event["outcome"] != "integrated":
                self._other.append(event["outcome"])
            self._changed.notify_all()

    def wait(self, number: int) -> None:
        """Until so many clouds are decided; RuntimeError if one of them was not integrated, or none comes any more."""
        with self._changed:
            while len(self.times) < number:
                before = len(self.times)
                if not self._changed.wait(WAIT_S) and len(self.times) == before:
                    raise RuntimeError(f"{before} of {number} clouds were decided")
            if self._other:
                raise RuntimeError(f"clouds were not integrated: {sorted(set(self._other))}")

    def close(self) -> None:
        """Hear no more."""
        self._subscriber.undeclare()


class Sender:
    """The drive, to and fro without end, as messages of one robot. Sweep k begins at ``START_NS`` + k sweeps.

    ``own_times``: each point has the time of its column, else all have the stamp.
    """

    def __init__(
        self, recording: Recording, *, own_times: bool, robot: str = ROBOT, shift: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        self.bytes = 0
        self._recording = recording
        self._own_times = own_times
        self._robot = robot
        self._position = recording.position + np.array([*shift, 0.0])
        self._turned = [np.argsort(columns, kind="stable") for columns in recording.columns]

    def _place(self, sweep: float) -> float:
        """Which scan's place the robot has reached, forth and back."""
        last = len(self._position) - 1
        return last - abs(sweep % (2 * last) - last) if last else 0.0

    def cloud(self, sweep: int) -> tuple[bytes, int]:
        """Its message, and how many points it has."""
        k = round(self._place(sweep))
        points, stamp = self._recording.points[k], START_NS + sweep * SWEEP_NS
        if not self._own_times:
            return encode_cloud(points, stamp, SENSOR), len(points)
        order = self._turned[k]
        offsets = self._recording.offsets_ns(k)[order]
        return encode_cloud(points[order], stamp, SENSOR, offsets_ns=offsets), len(points)

    def pose(self, stamp_ns: int) -> bytes:
        """The robot's at that time."""
        place = self._place((stamp_ns - START_NS) / SWEEP_NS)
        numbers = np.arange(len(self._position))
        position = [float(np.interp(place, numbers, self._position[:, n])) for n in range(3)]
        return encode_odometry(stamp_ns, "map", position, LEVEL, POSE_VARIANCE)

    def put(self, session: zenoh.Session, kind: str, payload: bytes) -> None:
        """Publish; nothing is dropped on this side."""
        self.bytes += len(payload)
        session.put(f"robots/{self._robot}/{kind}", payload, congestion_control=zenoh.CongestionControl.BLOCK)


@dataclass
class Driven:
    """What a drive at the pace of a robot came to; seconds each."""

    latency: list[float] = field(default_factory=list)
    """From the later of a scan's and its closing pose's being handed to Zenoh to its event: it is queryable then."""

    whole: list[float] = field(default_factory=list)
    """From the end of the sweep until its event came back."""


def drive(
    session: zenoh.Session, sender: Sender, first: int, sweeps: int, *, pose_hz: float, phase: float, skip: int = 0
) -> Driven:
    """Send sweeps at 10 Hz and poses at ``pose_hz``, each at its time; the first ``skip`` sweeps are not counted.

    A sweep's cloud is sent when the sweep ends. ``phase``, in parts of the poses' period: how long after a sweep's end
    the pose comes that closes it; 0: a pose of that very stamp, sent right before the cloud.
    """
    decided = Decided(session)
    period = round(1e9 / pose_hz)
    begin_ns, end_ns = START_NS + first * SWEEP_NS, START_NS + (first + sweeps) * SWEEP_NS
    lag = round(phase * period)
    poses = range(begin_ns + lag - (period if lag else 0), end_ns + lag + 1, period)
    # When, what comes first at one time, what, and which.
    tasks = [(stamp - begin_ns, 1, "pose", stamp) for stamp in poses]
    for k in range(sweeps):
        end = (k + 1) * SWEEP_NS
        tasks += [(end - SWEEP_NS // 2, 0, "encode", first + k), (end, 2, "cloud", first + k)]
    handed: dict[int, float] = {}
    closed: list[tuple[int, float]] = []
    ready = b""
    start = time.perf_counter() + 0.2
    for at, _, what, which in sorted(tasks):
        wait = start + at / 1e9 - time.perf_counter()
        if wait > 0:
            time.sleep(wait)
        if what == "encode":
            ready, _ = sender.cloud(which)
        elif what == "cloud":
            handed[which] = time.perf_counter()
            sender.put(session, "points", ready)
        else:
            payload = sender.pose(which)
            closed.append((which, time.perf_counter()))
            sender.put(session, "odometry", payload)
    decided.wait(sweeps)
    decided.close()
    found = Driven()
    for k in range(skip, sweeps):
        end = begin_ns + (k + 1) * SWEEP_NS
        closing = next(t for stamp, t in closed if stamp >= end)
        found.latency.append(decided.times[k] - max(handed[first + k], closing))
        found.whole.append(decided.times[k] - (start + (k + 1) * SWEEP_NS / 1e9))
    return found


def flood(session: zenoh.Session, sender: Sender, first: int, sweeps: int, window: int = 8) -> float:
    """Send sweeps as fast as they are taken up, ``window`` of them under way at most; seconds until all are decided."""
    decided = Decided(session)
    made = [(sender.cloud(first + k)[0], sender.pose(START_NS + (first + k) * SWEEP_NS)) for k in range(sweeps)]
    begun = time.perf_counter()
    for k, (cloud, pose) in enumerate(made):
        decided.wait(k - window)
        sender.put(session, "odometry", pose)
        sender.put(session, "points", cloud)
    decided.wait(sweeps)
    decided.close()
    return decided.times[-1] - begun


def fill(bench: Bench, session: zenoh.Session, recording: Recording, sites: list[tuple[float, float]]) -> None:
    """The drive's first scan at each of some places, by a robot of its own each: the map then covers them all."""
    bench.say(f"filling the map at {len(sites)} places")
    decided = Decided(session)
    for n, shift in enumerate(sites):
        sender = Sender(recording, own_times=False, robot=f"filler{n}", shift=shift)
        sender.put(session, "odometry", sender.pose(START_NS))
        sender.put(session, "points", sender.cloud(0)[0])
        decided.wait(n - 4)
    decided.wait(len(sites))
    decided.close()
