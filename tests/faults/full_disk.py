"""A disk that is full, broken, read-only or hangs under a service at work: degraded, answering, refusing, and back."""

import errno
import random
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import zenoh
from load import Fleet, settings
from net import WAIT_S, peer_config
from processes import T0, Service, read_log, replay
from report import Trial
from shim import Shim

from roughmap_client import QueryRefused, RoughMapClient
from roughmap_client.session import ask
from roughmap_schemas import encode_odometry

FAULTS: tuple[tuple[str, tuple[str, ...], int, str], ...] = (
    ("ENOSPC", ("write", "sync", "open"), 1, ""),
    ("ENOSPC", ("write",), 1, "log"),
    ("ENOSPC", ("write",), 2, "log"),
    ("ENOSPC", ("write",), 3, "log"),
    ("ENOSPC", ("sync",), 1, "log"),
    ("ENOSPC", ("sync",), 2, "log"),
    ("ENOSPC", ("write", "sync", "open"), 5, ""),
    ("ENOSPC", ("write", "sync", "open"), 1, "store"),
    ("EIO", ("write",), 1, "log"),
    ("EIO", ("sync",), 1, "log"),
    ("EIO", ("sync",), 3, ""),
    ("EROFS", ("write", "open", "rename"), 1, ""),
)
"""Error, calls, every how many-th fails, and of which files ("": of both)."""


def full_disks(trial: Trial, folder: Path, rng: random.Random, number: int) -> None:
    """One service under load; ``number`` times a fault comes over its disk and goes."""
    shim = Shim(folder)
    fleet = Fleet(rng.randrange(1 << 30))
    with Service(folder, environ=shim.environ, **settings(shim.root)) as service:
        endpoints = service.ready()["endpoints"]
        with zenoh.open(peer_config(connect=endpoints)) as session, fleet.at_work(endpoints):
            client = RoughMapClient("site", session=session, timeout=WAIT_S)
            trial.expect(fleet.wait_promised(50), "no receipts at all")
            for n in range(number):
                error, calls, every, only = FAULTS[n % len(FAULTS)]
                name = f"{error} at every {every}. {' and '.join(calls)} of {only or 'log and store'}"
                with shim.failing(*calls, every=every, error=getattr(errno, error), only=only):
                    _wait_failed(trial, shim, name)
                    if only == "store":
                        _stored_nowhere(trial, client, fleet, name)
                    elif every == 1:
                        _refuses(trial, client, session, name, stamp=T0 + n)
                    _answers(trial, client, name)
                _goes_on(trial, client, fleet, name)
                trial.once()
        _ends(trial, service, fleet, endpoints)
    trial.note("calls that failed", shim.failed)
    _whole(trial, fleet, shim.root / "log")


def hung_disks(trial: Trial, folder: Path, rng: random.Random, number: int) -> None:
    """The same with a disk of the log that answers nothing for a while, in turns its syncs, its writes and both."""
    shim = Shim(folder)
    fleet = Fleet(rng.randrange(1 << 30))
    elsewhere = {"spill_path": str(folder / "tiles.spill")}  # where it hangs nobody tells requests why
    with Service(folder, environ=shim.environ, **settings(shim.root, map=elsewhere)) as service:
        endpoints = service.ready()["endpoints"]
        with zenoh.open(peer_config(connect=endpoints)) as session, fleet.at_work(endpoints):
            client = RoughMapClient("site", session=session, timeout=WAIT_S)
            trial.expect(fleet.wait_promised(50), "no receipts at all")
            for n in range(number):
                name = f"hung {('writes', 'syncs', 'syncs and writes')[n % 3]} of the log"
                with shim.hanging(syncs=n % 3 != 0, writes=n % 3 != 1, only="log"):
                    _refuses(trial, client, session, name, stamp=T0 + n)
                    _answers(trial, client, name)
                _goes_on(trial, client, fleet, name)
                trial.once()
        _ends(trial, service, fleet, endpoints)
    _whole(trial, fleet, shim.root / "log")


def _goes_on(trial: Trial, client: RoughMapClient, fleet: Fleet, name: str) -> None:
    before = fleet.promised
    trial.expect(_comes(client, "ok"), f"{name}: not ok again afterwards")
    trial.expect(fleet.wait_promised(before + 20), f"{name}: no receipts afterwards")


def _ends(trial: Trial, service: Service, fleet: Fleet, endpoints: list[str]) -> None:
    """In order, once all that was handed in is acknowledged."""
    with fleet.at_work(endpoints, most=5, asking=False) as done:
        trial.expect(done.wait(WAIT_S), f"not acknowledged: {fleet.left()}")
    trial.expect(service.stop() == 0, f"the end: {service.err[-3:]}")


def _wait_failed(trial: Trial, shim: Shim, name: str) -> None:
    seen = shim.failed
    for _ in range(200):
        if shim.failed > seen + 3:
            break
        threading.Event().wait(0.05)
    trial.expect(shim.failed > seen, f"{name}: nothing failed")


def _refuses(trial: Trial, client: RoughMapClient, session: zenoh.Session, name: str, stamp: int) -> None:
    """Nothing reaches the log: that is said, and nothing acknowledged."""
    trial.expect(_comes(client, "degraded"), f"{name}: not degraded")
    payload = encode_odometry(stamp, "map", (0, 0, 0), (0, 0, 0, 1))
    code = ""
    try:
        ask(session, "maps/site/ingest/late/odometry", timeout=WAIT_S, payload=payload).single()
    except QueryRefused as refused:
        code = refused.code
    trial.expect(code == "log_unavailable", f"{name}: ingest answered {code or 'with a receipt'}")
    trial.note("were degraded")


def _stored_nowhere(trial: Trial, client: RoughMapClient, fleet: Fleet, name: str) -> None:
    """No snapshot can be made: that is said, and all else goes on."""
    trial.expect(_comes(client, "degraded"), f"{name}: not degraded")
    before = fleet.promised
    trial.expect(fleet.wait_promised(before + 20), f"{name}: no receipts meanwhile")
    trial.note("were degraded, and took in")


def _answers(trial: Trial, client: RoughMapClient, name: str) -> None:
    answer = client.region((-45.0, -45.0, 45.0, 45.0), ["mean_height"], level=2)
    trial.expect(answer.known_cells > 0, f"{name}: a query found nothing")


def _comes(client: RoughMapClient, health: str) -> bool:
    for _ in range(300):
        if client.status().health == health:
            return True
        threading.Event().wait(0.05)
    return False


def _whole(trial: Trial, fleet: Fleet, log: Path) -> None:
    """In the end all is there, once, and no file that holds nothing is left of the tries."""
    for broken in fleet.broken_promises(log):
        trial.expect(False, broken)
    code, verdict = replay(log)
    trial.expect(code == 0, f"replay: {verdict}")
    files = sorted(log.glob("*.mcap"))
    topics = {path: {one.topic for one in read_log_of(path)} for path in files}
    empty = [path.name for path in files if not topics[path]]
    trial.expect(len(empty) <= 1, f"{len(empty)} of {len(files)} files hold nothing: {empty[:3]}")


def read_log_of(path: Path) -> list[object]:
    """The messages of one file."""
    with_file = path.parent / "one"
    with_file.mkdir(exist_ok=True)
    target = with_file / path.name
    shutil.copyfile(path, target)
    try:
        return list(read_log(with_file))
    finally:
        shutil.rmtree(with_file)


@contextmanager
def small_disk(where: Path, size: str) -> Iterator[bool]:
    """A file system of its own with little room, if this user may mount one."""
    where.mkdir(parents=True)
    mounted = not subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(where)], capture_output=True, check=False
    ).returncode
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(where)], check=True)


def real_disk(trial: Trial, folder: Path, rng: random.Random, number: int) -> None:
    """The same with no shim: a real file system that is full, and one that is read-only."""
    for n in range(number):
        with small_disk(folder / f"disk-{n}", "24m") as mounted:
            if not mounted:
                trial.note("not tried: this user may mount nothing")
                return
            _fill_up(trial, folder / f"disk-{n}", rng)
        trial.once()


def _fill_up(trial: Trial, disk: Path, rng: random.Random) -> None:
    filler, fleet = disk / "filler", Fleet(rng.randrange(1 << 30))
    filler.write_bytes(bytes(10 << 20))
    given = settings(disk)
    with Service(disk.parent / f"{disk.name}-conf", **given) as service:
        endpoints = service.ready()["endpoints"]
        with zenoh.open(peer_config(connect=endpoints)) as session, fleet.at_work(endpoints):
            client = RoughMapClient("site", session=session, timeout=WAIT_S)
            trial.expect(fleet.wait_promised(20), "no receipts at all")
            with suppress(OSError), (disk / "more").open("wb") as more:
                while True:
                    more.write(bytes(1 << 16))
                    more.flush()
            trial.expect(_comes(client, "degraded"), "a full file system: not degraded")
            trial.expect(client.region((-45.0, -45.0, 45.0, 45.0), level=2).known_cells > 0, "a query found nothing")
            (disk / "more").unlink()
            filler.unlink()
            before = fleet.promised
            trial.expect(_comes(client, "ok"), "a full file system: not ok when there is room")
            trial.expect(fleet.wait_promised(before + 20), "no receipts when there is room")
        _ends(trial, service, fleet, endpoints)
    _whole(trial, fleet, disk / "log")
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
    with Service(disk.parent / f"{disk.name}-conf", **given) as service:
        code = service.finished(60.0)
        said = [line for line in service.err if line.startswith("roughmap: ")]
        trial.expect(code in (1, 2) and len(said) == 1 and str(disk) in said[0], f"read-only: {code}, {said}")
        trial.note("read-only starts refused by name")
