"""No memory for a cloud, two starts at once, a signal on the way up, and an end that the disk does not take."""

import errno
import json
import random
import re
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import paths  # noqa: F401 - before what it makes importable
import pytest
import zenoh
from load import dense
from net import WAIT_S, peer_config
from processes import STOP_S, T0, Service, connected, replay
from service_tools import LoggedRun, config
from shim import Shim

from roughmap_schemas import encode_cloud


@pytest.fixture
def shim(tmp_path: Path) -> Shim:
    return Shim(tmp_path / "shim")


def spread(number: int, tiles: int) -> bytes:
    """A cloud over tiles in which no other cloud has points."""
    x = 6.4 * (np.arange(tiles) + 0.5) + 1000.0 * number
    return encode_cloud(np.stack([x, np.full(tiles, 3.2), np.zeros(tiles)], axis=1), T0 + number, "map")


def test_no_memory_for_a_cloud_is_an_event(tmp_path: Path, shim: Shim) -> None:
    """The cloud ends as one of an overload, the map goes on, and a replay that has the memory says the same."""
    settings = {"directory": str(shim.root / "log")}
    with Service(tmp_path, environ=shim.environ, log=settings) as service, connected(service) as feed:
        assert feed.decided(feed.ingest("points", "r1", spread(1, 10)).input).outcome == "integrated"
        shim.set("maps", 1)
        refused = feed.decided(feed.ingest("points", "r1", spread(2, 300)).input)
        assert (str(refused.outcome), refused.accepted, refused.sequence) == ("overload", 0, 1)
        assert shim.failed > 0
        assert feed.client.status().health == "overloaded"
        shim.set("maps", 0)
        assert feed.decided(feed.ingest("points", "r1", spread(3, 300)).input).sequence == 2
        assert service.stop() == 0
    code, verdict = replay(shim.root / "log")
    assert (code, ", sequence 2," in verdict) == (0, True), verdict


@pytest.fixture
def router() -> Iterator[list[str]]:
    with zenoh.open(peer_config(listen=True, mode="router")) as session:
        told = [r.ok for r in session.get(f"@/{session.zid()}/router", timeout=WAIT_S) if r.ok is not None]
        yield [str(locator) for locator in json.loads(told[0].payload.to_bytes())["locators"]]


def test_of_two_starts_at_once_one_serves(tmp_path: Path, router: list[str]) -> None:
    """Each with a log of its own, so that only the map's name keeps them apart; neither sees the other finished."""
    settings = {"zenoh": {"listen": [], "mode": "client", "connect": router}, "service": {"alive_wait": 3.0}}
    with Service(tmp_path / "a", **settings) as a, Service(tmp_path / "b", **settings) as b:
        ended = threading.Event()
        for service in (a, b):
            threading.Thread(target=lambda s=service: (s.process.wait(), ended.set()), daemon=True).start()
        assert ended.wait(60.0), "both of them serve the map"
        loser, winner = (a, b) if a.process.poll() is not None else (b, a)
        assert loser.finished() == 2
        assert "is served already, by maps/site/alive/" in loser.err[-1]
        assert winner.ready()["ready"]
        assert winner.stop() == 0


def test_a_signal_during_the_start_takes_effect(tmp_path: Path) -> None:
    """While it folds a log it ends at once, with nothing begun; the next start has all."""
    rng = random.Random(1)
    with LoggedRun(tmp_path / "log", config(log={"directory": str(tmp_path / "log")})) as run:
        for k in range(400):
            run.scan(float(k), 0.1 * rng.random())
        run.checkpoint()
        sequence = run.run.map.sequence
    before = sorted(path.name for path in (tmp_path / "log").glob("*.mcap"))
    with Service(tmp_path) as service:
        service.line("rebuilding the map from the log", 100.0)
        assert service.stop() == 0
        assert service.out == [], "it was not ready"
    assert sorted(path.name for path in (tmp_path / "log").glob("*.mcap")) == before
    with Service(tmp_path) as service, connected(service) as feed:
        assert feed.client.status().sequence == sequence
        assert service.stop(signal.SIGINT) == 0


def test_an_end_that_the_disk_does_not_take_is_no_good_end(tmp_path: Path, shim: Shim) -> None:
    settings = {"directory": str(shim.root / "log")}
    limit = {"shutdown_timeout": 4.0}
    with (
        Service(tmp_path, environ=shim.environ, log=settings, service=limit) as service,
        connected(service) as feed,
    ):
        feed.decided(feed.ingest("points", "r1", spread(1, 10)).input)
        feed.settle()
        with shim.failing("write", "sync", error=errno.EIO):
            feed.put("points", "r1", spread(2, 10))
            assert service.stop() == 1
    assert any(line.startswith("roughmap: the end of the log is lost: ") for line in service.err), service.err[-5:]
    assert any(re.search(r"its last [1-9]\d* records are lost", line) for line in service.err), service.err[-5:]
    code, verdict = replay(shim.root / "log")
    assert code == 0 or "no checkpoint" in verdict, verdict


def test_an_end_that_the_spill_file_holds_up_is_no_good_end(tmp_path: Path, shim: Shim) -> None:
    """The log takes all; the map's tiles find no room in memory, and the sequencer waits for their disk."""
    with (
        Service(
            tmp_path,
            environ=shim.environ,
            log={"directory": str(shim.root / "log")},
            map={"memory_limit": "8MiB", "spill_path": str(shim.root / "tiles.spill")},
            service={"shutdown_timeout": 4.0},
        ) as service,
        connected(service) as feed,
        shim.hanging(syncs=False, writes=True, only="store"),
    ):
        feed.ingest("points", "r1", dense(0))
        assert service.stop() == 1
    last = service.err[-5:]
    assert any(line.startswith("roughmap: the sequencer did not end in time; ") for line in service.err), last
    assert not any("shut down in order" in line for line in service.err)


def test_an_end_that_takes_too_long_is_cut_short(tmp_path: Path, shim: Shim) -> None:
    """A disk that hangs for ever can't hold up the end beyond its limit."""
    settings = {"directory": str(shim.root / "log")}
    limit = {"shutdown_timeout": 2.0}
    with (
        Service(tmp_path, environ=shim.environ, log=settings, service=limit) as service,
        connected(service) as feed,
    ):
        feed.ingest("points", "r1", spread(1, 10))
        shim.set("hang", 1)
        feed.put("points", "r1", spread(2, 10))
        assert service.stop() == 1
    assert any("shutdown_timeout" in line or "the end of the log is lost" in line for line in service.err)


def test_a_second_signal_ends_it_at_once(tmp_path: Path, shim: Shim) -> None:
    """A disk that hangs keeps the first one's end from coming before the second; its limit is too far off to be it."""
    settings = {"directory": str(shim.root / "log")}
    limit = {"shutdown_timeout": 10 * STOP_S}
    with (
        Service(tmp_path, environ=shim.environ, log=settings, service=limit) as service,
        connected(service) as feed,
    ):
        feed.ingest("points", "r1", spread(1, 10))
        shim.set("hang", 1)
        service.process.send_signal(signal.SIGTERM)
        service.line("shutting down")
        service.process.send_signal(signal.SIGINT)
        assert service.finished() == 1
    assert not any("shutdown_timeout" in line for line in service.err)
