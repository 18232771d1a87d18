"""Scans, queries, updates, snapshots, spilling and resets all at once against one real service.

A scan covers a plate whose cells each get exactly one of its points, all at one height, the next scan's at another: so
a reader that sees cells of the plate with different counts or means saw half of a scan. ``--storm-seconds 60``: longer.
"""

import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from net import WAIT_S, Gathered
from processes import LEVEL, PRECISE, T0, Feed, running

from roughmap_client import QueryRefused, Tile
from roughmap_client.session import ask
from roughmap_schemas import ControlAnswer, MapStatus, encode_cloud, encode_odometry

S = 10**9
MIB = 1 << 20
SIDE = 160
"""Cells along the plate: 3 x 3 tiles, some of them in part."""

CELLS = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), axis=-1).reshape(-1, 2)
PLATE = (0.0, 0.0, SIDE * 0.1, SIDE * 0.1)
HEIGHTS = (1.0, 3.0)

STRIP = 40
"""Tiles of a scan over other ground, 64 points each: 10 MiB, more than the memory limit after a few of them."""


def plate(number: int) -> bytes:
    points = np.column_stack(((CELLS + 0.5) * 0.1, np.full(len(CELLS), HEIGHTS[number % 2])))
    return encode_cloud(points, T0 + number * S // 100, "map")


def strip(number: int) -> bytes:
    x = (np.repeat(np.arange(STRIP), 64) + 0.5) * 6.4
    y = (np.tile(np.arange(64), STRIP) + 0.5) * 0.1 + (10 + number % 30) * 6.4
    return encode_cloud(np.column_stack((x, y, np.sin(x + number))), T0 + number * S // 100, "map")


class Storm:
    """What goes on at once, each in a thread; the first thing that is not as it must be ends it."""

    def __init__(self, feed: Feed) -> None:
        self.feed = feed
        self.stop = threading.Event()
        self.failures: list[BaseException] = []
        self.done: Counter[str] = Counter()
        self.sent = 0
        self._lock = threading.Lock()
        self._threads: list[threading.Thread] = []

    def start(self, name: str, step: Callable[[int], None]) -> None:
        def run() -> None:
            number = 0
            try:
                while not self.stop.is_set():
                    step(number)
                    number += 1
                    with self._lock:
                        self.done[name] += 1
            except BaseException as error:  # noqa: BLE001 - it is raised again in `end`
                self.failures.append(error)
                self.stop.set()

        thread = threading.Thread(target=run, name=name)
        self._threads.append(thread)
        thread.start()

    def count(self, number: int = 1) -> None:
        with self._lock:
            self.sent += number

    def end(self) -> None:
        self.stop.set()
        for thread in self._threads:
            thread.join(2 * WAIT_S)
            assert not thread.is_alive(), thread.name
        if self.failures:
            raise self.failures[0]

    def hand_in(self, kind: str, robot: str, payload: bytes) -> None:
        """One request; a refusal is counted by the service as this message is counted here."""
        self.count()
        answer = ask(self.feed.session, f"maps/site/ingest/{robot}/{kind}", timeout=WAIT_S, payload=payload)
        try:
            answer.single()
        except QueryRefused as refusal:
            if refusal.code != "busy":
                raise


class Reader:
    """One who asks again and again, and holds every answer against the one before."""

    def __init__(self, storm: Storm) -> None:
        self.storm = storm
        self.client = storm.feed.client
        self.seen = (0, 0)
        self.counts: set[int] = set()

    def rises(self, epoch: int, sequence: int) -> None:
        assert (epoch, sequence) >= self.seen, "the map went back"
        self.seen = (epoch, sequence)

    def __call__(self, number: int) -> None:
        try:
            (self.region, self.tiles, self.cells, self.everything)[number % 4]()
        except QueryRefused as refusal:
            if refusal.code != "busy":
                raise

    def one_scan(self, counts: np.ndarray, means: np.ndarray) -> None:
        """All cells have had the same scans."""
        assert counts.min() == counts.max(), f"half a scan: counts {np.unique(counts)}"
        count = int(counts.max())
        self.counts.add(count)
        if count:
            assert np.unique(means).size == 1, "half a scan"
            assert HEIGHTS[0] <= means.flat[0] <= HEIGHTS[1]

    def region(self) -> None:
        got = self.client.region(PLATE, ["count", "mean_height"], dtype="f8")
        self.rises(*got.version[:2])
        self.one_scan(got["count"], got["mean_height"])

    def tiles(self) -> None:
        tiles = self.client.tiles(PLATE, ["count", "mean_height"])
        if not tiles:
            return
        assert len({tile.version for tile in tiles}) == 1
        assert len(tiles) == 9
        self.rises(*tiles[0].version[:2])
        inside = [self.inside(tile) for tile in tiles]
        self.one_scan(
            np.concatenate([tile["count"][cut].ravel() for tile, cut in inside]),
            np.concatenate([tile["mean_height"][cut].ravel() for tile, cut in inside]),
        )

    @staticmethod
    def inside(tile: Tile) -> tuple[Tile, tuple[slice, slice]]:
        _, x, y = tile.key
        return tile, (slice(0, min(64, SIDE - 64 * y)), slice(0, min(64, SIDE - 64 * x)))

    def cells(self) -> None:
        places = [((i + 0.5) * 0.1, (i + 0.5) * 0.1) for i in range(0, SIDE, 7)]
        got = self.client.cells(places, ["count", "mean_height"])
        self.rises(*got.version[:2])
        self.one_scan(got["count"], got["mean_height"])

    def everything(self) -> None:
        """Spilled tiles too, at a coarse level."""
        tiles = self.client.tiles(None, ["mean_height", "slope"], level=3)
        assert len({tile.version for tile in tiles}) <= 1


class Watcher:
    """What is published of the plate's tiles: each of one scan, and later ones of later states."""

    def __init__(self) -> None:
        self.failures: list[str] = []
        self.seen: dict[tuple[int, int, int], tuple[int, int]] = {}
        self.updates: Gathered[tuple[int, int, int]] = Gathered()

    @property
    def number(self) -> int:
        return len(self.updates.items)

    def __call__(self, tile: Tile) -> None:
        self.updates(tile.key)
        version = (tile.info.epoch, tile.info.sequence)
        if version <= self.seen.get(tile.key, (0, 0)) and tile.known_cells:
            self.failures.append(f"{tile.key} at {version} after {self.seen[tile.key]}")
        self.seen[tile.key] = version
        z, x, y = tile.key
        if z == 0 and 0 <= x < 3 and 0 <= y < 3 and tile.known_cells:
            counts = tile["count"][Reader.inside(tile)[1]]
            if counts.min() != counts.max():
                self.failures.append(f"half a scan in {tile.key}")


def control(feed: Feed, action: str) -> ControlAnswer:
    part = ask(feed.session, f"maps/site/control/{action}", timeout=WAIT_S, payload=b"").single()
    return ControlAnswer.model_validate_json(part.payload)


def sums(status: MapStatus) -> int:
    """All that came in, by what became of it."""
    clouds, poses = status.clouds, status.poses
    return (
        clouds.accepted + sum(clouds.rejected.values()) + clouds.waiting
        + poses.accepted + sum(poses.rejected.values()) + sum(status.refused.values())
    )  # fmt: skip


def test_all_at_once(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """The end of `running` shows that it stops in order and that the log replays to the same digests."""
    seconds = request.config.getoption("--storm-seconds")
    settings = {
        "map": {"error_model": "point", "memory_limit": 24 * MIB},
        "store": {"path": str(tmp_path / "map.db"), "snapshot_interval": 0.3},
        "updates": {"layers": ["count"], "levels": [0, 1], "update_hz": 20.0},
        "log": {"max_file_bytes": 8 * MIB},
    }
    pose = encode_odometry(T0, "map", (0, 0, 0), LEVEL, PRECISE)
    with running(tmp_path, **settings) as (service, feed), ExitStack() as stack:
        storm, watcher = Storm(feed), Watcher()
        first = feed.settle()
        epochs, spilled = [first.epoch], [0]
        readers = [Reader(storm), Reader(storm)]
        stack.enter_context(feed.client.watch(watcher, level=0))
        statuses: Gathered[int] = Gathered()
        subscriber = feed.session.declare_subscriber(
            "maps/site/status", lambda s: statuses(MapStatus.model_validate_json(s.payload.to_bytes()).sequence)
        )
        stack.callback(subscriber.undeclare)

        def scan(number: int) -> None:
            storm.hand_in("points", "plate", plate(number))
            if number % 5 == 4:
                storm.hand_in("points", "strips", strip(number))

        def noise(number: int) -> None:
            """Poses, and what is none; the status, which paces it."""
            storm.count(2)
            feed.put("odometry", "noise", encode_odometry(T0 + number * S // 10, "map", (0, 0, 0), LEVEL, PRECISE))
            feed.put("odometry", "noise", pose[:-1])
            status = feed.client.status()
            assert status.health in {"ok", "overloaded"}
            spilled.append(status.tiles.spilled)

        def operate(number: int) -> None:
            storm.stop.wait(seconds / 8)
            answer = control(feed, ("snapshot", "reset")[number % 2])
            if number % 2:
                epochs.append(answer.epoch)

        begun = time.monotonic()
        storm.start("scans", scan)
        storm.start("noise", noise)
        storm.start("operator", operate)
        for number, reader in enumerate(readers):
            storm.start(f"reader {number}", reader)
        storm.stop.wait(seconds)
        storm.end()
        took = time.monotonic() - begun
        last = feed.settle()
        assert sums(last) - sums(first) == storm.sent + feed.settles - 1
        assert last.refused["bad_message"] == storm.done["noise"]  # type: ignore[index]
        assert last.health == "ok"
        assert last.log.ok
        assert epochs == sorted(set(epochs))
        assert last.epoch == epochs[-1]
        assert len(epochs) > 2, "resets"
        assert max(spilled) > STRIP, "tiles that left memory"
        assert watcher.number
        assert not watcher.failures, watcher.failures[:3]
        assert all(len(reader.counts) > 3 for reader in readers), "states that were seen"
        # Each part still does its work: a receipt (log), an event, an update, a snapshot, the published status.
        told = watcher.number
        feed.decided(feed.ingest("points", "plate", plate(10**6)).input)
        assert control(feed, "snapshot").sequence > last.sequence
        statuses.wait(lambda items: bool(items) and items[-1] > last.sequence, "the published status")
        watcher.updates.wait(lambda items: len(items) > told, "an update")
        bad = [line for line in service.err if '"error"' in line or '"critical"' in line]
        assert not bad
        print(f"{took:.0f} s: {dict(storm.done)}, {storm.sent} messages, {last.sequence} changes")
        print(f"{watcher.number} updates, {max(spilled)} tiles spilled, epochs {epochs}")
