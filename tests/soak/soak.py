"""make soak ARGS="--minutes 15"

A service as it runs for weeks, in short: two robots drive an endless way, a planner asks, a watcher listens, requests
to ingest come, the log rotates and loses its oldest files, tiles spill, and it is ended once and killed once. What it
takes of the machine is sampled; after the warm-up it must stay flat. At the end its log is replayed. Writes a picture
and the samples (JSON) into soak/; exits 1 by what grew.
"""

import argparse
import contextlib
import json
import sqlite3
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path

import soak_paths  # noqa: F401 - before what it makes importable
import zenoh
from feeder import Feed, S
from feeding import Robot
from net import WAIT_S, peer_config
from processes import LEVEL, PRECISE, T0, Service, replay
from samples import MIB, Allowed, Asking, beside_tiles, growth, opened, p99, resident, size, threads
from soak_picture import draw

from roughmap_client import RoughMapClient, RoughMapError
from roughmap_schemas import MapStatus, encode_cloud, encode_odometry

LIMIT = 256 * MIB
FILE = 32 * MIB
KEEP = 160 * MIB
CLOUDS_HZ = 10.0
POINTS = 4000
SPEED = 5.0
"""Metres a second: fast enough that the limit of memory is met within the first minutes."""

RESTARTS = (0.08, 0.16)
WARM = 0.4
"""Parts of the run: where it is ended and killed, and from where on it must be flat."""

TILE = 1024
"""Bytes of memory for a tile that is not resident: key, place, digest, stamps, and its share of the levels' lists."""

SETTINGS: dict[str, dict[str, object]] = {
    "map": {"memory_limit": LIMIT},
    "input": {"queue_limit": 16 * MIB, "max_message": 16 * MIB},
    "log": {"max_file_bytes": FILE, "keep": KEEP, "queue_limit": 32 * MIB},
    "service": {"alive_wait": 0.2, "shutdown_timeout": 60.0},
    "query": {"cache_limit": 16 * MIB},
}


@dataclass
class Soaked:
    """What came of a run: samples by name, when the service was restarted, what was counted, what is broken."""

    samples: list[dict[str, float]] = field(default_factory=list)
    starts: list[float] = field(default_factory=list)
    warm: float = 0.0
    numbers: dict[str, object] = field(default_factory=dict)
    broken: list[str] = field(default_factory=list)

    def column(self, name: str) -> list[float]:
        """A quantity after the warm-up, while it was not overloaded: full queues take memory, as they may."""
        return [sample[name] for sample in self.samples if sample["t"] >= self.warm and sample["ok"]]


def judge(soaked: Soaked, *, flat: bool) -> None:
    """Hold the samples after the warm-up against what they may be; ``flat``: the run was long enough to see a trend."""
    t, tiles = soaked.column("t"), soaked.column("tiles")
    if len(t) < 2 or len(t) < 0.5 * sum(sample["t"] >= soaked.warm for sample in soaked.samples):
        soaked.broken.append("it was overloaded, or degraded, most of the time: nothing can be judged on this machine")
        return
    new = growth(t, tiles)
    allowed = {
        "rss": Allowed(8 * MIB + TILE * new, f"8 MiB for the allocator, and {TILE} bytes for each new tile"),
        "beside_tiles": Allowed(16 * MIB + TILE * new, "as rss, and what Zenoh and answers take at their first peaks"),
        "descriptors": Allowed(3, "log files and the store's come and go"),
        "threads": Allowed(2, "a snapshot's comes and goes"),
        "log": Allowed(FILE, "the file that is being written"),
        "store_a_tile": Allowed(0.1 * soaked.column("store_a_tile")[0] + 1024, "a tenth: ground differs"),
    }
    told = {}
    for name, limit in allowed.items():
        rose = growth(t, soaked.column(name))
        told[name] = {"rose": round(rose, 2), "allowed": round(limit.growth, 2), "since": limit.why}
        if flat and rose > limit.growth:
            soaked.broken.append(f"{name} rose by {rose:.0f}; {limit.growth:.0f} are allowed: {limit.why}")
    soaked.numbers["growth"] = told
    if max(soaked.column("log")) > KEEP + 3 * FILE:
        soaked.broken.append(f"the log has {max(soaked.column('log')) / MIB:.0f} MiB")
    if max(soaked.column("spill")) > 300 * 1024 * max(tiles):
        soaked.broken.append("the spill file is larger than the map")


class Soak:
    """The run; `go` does it."""

    def __init__(self, folder: Path, seconds: float, every: float, say: Callable[[str], None]) -> None:
        self._folder = folder
        self._seconds = seconds
        self._every = every
        self._say = say
        self._store = folder / "store" / "map.db"
        self._cut = folder / "cut.db"
        self._second = 0.0
        self._begun = time.monotonic()
        self._ingested = 0
        self._asked = 0
        self._updates = 0
        self.found = Soaked(warm=WARM * seconds)

    def go(self) -> Soaked:
        """All parts of it, with the restarts between them; then the replay."""
        ends = [part * self._seconds for part in RESTARTS] + [self._seconds]
        self._begun = time.monotonic()
        for number, until in enumerate(ends):
            with Service(
                self._folder, **SETTINGS, store={"path": str(self._store), "snapshot_interval": 5.0}
            ) as service:
                service.ready()
                self.found.starts.append(now := time.monotonic() - self._begun)
                # However long the start took, it is looked at for a while.
                self._live(service, max(until, now + 6 * self._every), last=until == self._seconds)
                if number == 1:
                    self._say("it is killed")
                    service.kill()
                elif service.stop() != 0:
                    self.found.broken.append(f"it did not end well: {service.err[-3:]}")
        self._say("its log is replayed")
        code, verdict = replay(self._folder / "log", "--from", self._cut)
        if code != 0 or not verdict.startswith("equal"):
            self.found.broken.append(f"the replay: {verdict}")
        self.found.numbers |= {
            "answers": self._asked, "updates": self._updates, "ingested": self._ingested, "replay": verdict,
            "samples": len(self.found.samples),
        }  # fmt: skip
        for what in ("answers", "updates", "ingested"):
            if not self.found.numbers[what]:
                self.found.broken.append(f"no {what}")
        return self.found

    def _live(self, service: Service, until: float, *, last: bool) -> None:
        """One life of the service."""
        endpoints = service.ready()["endpoints"]
        cut_at = max(until - 60.0, until - 0.2 * self._seconds)
        with ExitStack() as stack:
            session = stack.enter_context(zenoh.open(peer_config(connect=endpoints)))
            client = stack.enter_context(RoughMapClient("site", session=session, timeout=WAIT_S))
            feeds = [
                Feed(endpoints, f"rover{n}", CLOUDS_HZ, POINTS, SPEED, 30.0 * n, second=self._second) for n in (1, 2)
            ]
            robots = [stack.enter_context(Robot(feed)) for feed in feeds]
            watcher = session.declare_subscriber("maps/site/updates/**", self._watched)
            asking = stack.enter_context(Asking(client, 10.0, side=20.0))
            stop = threading.Event()
            hand = threading.Thread(target=self._ingest, args=(client, stop), daemon=True)
            hand.start()
            cut = not last
            told = time.monotonic()
            while (now := time.monotonic() - self._begun) < until:
                status = client.status()
                if status.newest_stamp_ns:
                    asking.place = feeds[0].position((status.newest_stamp_ns - T0) / S)[:2]
                self._sample(service, status, asking.taken(), now)
                if not cut and now >= cut_at:
                    cut = self._take_cut(session)
                if time.monotonic() - told > 30.0:
                    told = time.monotonic()
                    self._say(" ".join(f"{name} {value:.4g}" for name, value in self.found.samples[-1].items()))
                stop.wait(self._every)
            stop.set()
            hand.join(WAIT_S)
            ends = [robot.end() for robot in robots]
            self._second = float(max(one["second"] for one in ends))
            watcher.undeclare()
            self._asked += asking.asked
            if asking.failed:
                self.found.broken.append(f"answers failed: {asking.failed[:3]}")
            final = client.status()
            counted = {str(k): n for k, n in {**final.clouds.rejected, **final.refused}.items() if n}
            self.found.numbers[f"life {len(self.found.starts)}"] = {
                "sent": sum(one["clouds"] for one in ends), "integrated": final.clouds.accepted, "dropped": counted,
                "gaps": dict(final.gaps),
            }  # fmt: skip

    def _watched(self, _: zenoh.Sample) -> None:
        self._updates += 1

    def _ingest(self, client: RoughMapClient, stop: threading.Event) -> None:
        """A third robot hands in a pose and a scan a second, each once it is sure of the one before."""
        x = 0.0
        while not stop.wait(1.0):
            stamp = T0 + round((time.monotonic() - self._begun) * S)
            x += 1.0
            try:
                client.ingest(
                    encode_odometry(stamp, "map", (x % 50.0, -30.0, 1.0), LEVEL, PRECISE), "hand", kind="odometry"
                )
                points = [[1.0 + 0.1 * n, 0.05 * n, -1.0] for n in range(20)]
                client.ingest(encode_cloud(points, stamp, "lidar"), "hand", kind="points")
            except RoughMapError as error:
                if not stop.is_set():
                    self.found.broken.append(f"not ingested: {error}"[:300])
                continue
            self._ingested += 2

    def _sample(self, service: Service, status: MapStatus, taken: list[float], now: float) -> None:
        pid, log = service.process.pid, self._folder / "log"
        tiles = status.tiles.resident + status.tiles.spilled
        store, spill = size(list(self._store.parent.iterdir())), size([log / "tiles.spill"])
        self.found.samples.append(
            {
                "t": now, "rss": resident(pid), "beside_tiles": beside_tiles(pid),
                "descriptors": opened(pid), "threads": threads(pid), "log": size(list(log.glob("*.mcap"))),
                "store": store, "spill": spill, "tiles": tiles,
                "resident": status.tiles.resident, "store_a_tile": store / max(tiles, 1), "p99": p99(taken),
                "lag": status.lag_s.p99 or 0.0, "ok": float(status.health == "ok"),
            }
        )  # fmt: skip

    def _take_cut(self, session: zenoh.Session) -> bool:
        """A copy of the store as it is now: the run's beginning is deleted (`log.keep`), so the replay begins here."""
        for reply in session.get("maps/site/control/snapshot", timeout=WAIT_S):
            if reply.ok is None:
                self.found.broken.append("no snapshot was made")
        with contextlib.ExitStack() as stack:
            source = stack.enter_context(closing(sqlite3.connect(f"file:{self._store}?mode=ro", uri=True)))
            target = stack.enter_context(closing(sqlite3.connect(self._cut)))
            source.backup(target)
        return True


def main() -> int:
    """Parse, run, tell."""
    parser = argparse.ArgumentParser(prog="make soak", description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0, help="how long (default: 60)")
    parser.add_argument("--out", type=Path, default=Path("soak"), help="where picture and samples go (default: soak)")
    asked = parser.parse_args()
    seconds = asked.minutes * 60
    with tempfile.TemporaryDirectory(prefix="roughmap-soak-") as folder:
        say: Callable[[str], None] = lambda text: print(text, file=sys.stderr, flush=True)  # noqa: E731
        found = Soak(Path(folder), seconds, min(3.0, max(0.5, seconds / 300)), say).go()
    judge(found, flat=seconds >= 300)
    asked.out.mkdir(parents=True, exist_ok=True)
    whole = {"numbers": found.numbers, "broken": found.broken, "warm": found.warm, "samples": found.samples}
    (asked.out / "soak.json").write_text(json.dumps(whole, indent=1))
    picture = draw(found.samples, found.starts, found.warm, asked.out / "soak.png")
    print(json.dumps(found.numbers, indent=2))
    for line in found.broken:
        print(f"BROKEN: {line}")
    print(f"{'it holds' if not found.broken else 'it does not hold'}; look at {picture}")
    return 1 if found.broken else 0


if __name__ == "__main__":
    sys.exit(main())
