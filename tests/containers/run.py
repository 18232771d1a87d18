"""The image under what happens to containers: `make container-test` (docker or podman; as root; four minutes or so).

A router, the service and a simulated rover on a bridge network, all as little privileged as they can be. What was seen
is printed as it goes on, and at the end as a list. A failure ends it with exit 1 and the containers' last lines.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from engine import Engine, Failed, until

HERE = Path(__file__).resolve().parent
DOCKER = HERE.parent.parent / "docker"
ROUTER = "tcp/router:7447"
ASK = (HERE / "ask.py").read_text()

SERVICE = (
    "-e", "ROUGHMAP_ZENOH__MODE=client",
    "-e", "ROUGHMAP_ZENOH__LISTEN=",
    "-e", f'ROUGHMAP_ZENOH__CONNECT=["{ROUTER}"]',
    "-e", "ROUGHMAP_HTTP__LISTEN=0.0.0.0:8080",
    "-v", f"{DOCKER}/roughmap.toml:/etc/roughmap/roughmap.toml:ro",
)  # fmt: skip
"""As compose.yaml sets it."""

PYTHON = ("--entrypoint", "python")
FILLED = "64m"
"""The size of the volume that is filled: the map's first tiles and some seconds of a rover fit in."""


class Covered:
    """What was seen so far."""

    def __init__(self) -> None:
        self.items: list[str] = []
        self._begun = time.monotonic()

    def __call__(self, what: str) -> None:
        """Note and print that something was seen."""
        self.items.append(what)
        print(f"[{time.monotonic() - self._begun:4.0f} s] {what}", flush=True)


def expect(true: object, what: str) -> None:
    """Failed with ``what``, unless ``true``."""
    if not true:
        raise Failed(what)


def ask(engine: Engine) -> dict[str, Any]:
    """The map's digest and state, asked from a container of its own; Failed if there is no answer."""
    answer: dict[str, Any] = json.loads(engine.once("-", ROUTER, options=PYTHON, given=ASK, seconds=60))
    return answer


def lines(engine: Engine, name: str, event: str) -> list[dict[str, Any]]:
    """The service's log lines of one kind."""
    return [line for line in engine.logs(name) if line.get("event") == event]


def ready(engine: Engine, name: str, times: int = 1, seconds: float = 60) -> float:
    """Wait until it has become ready for the ``times``-th time; the seconds that it took then, by its own clock."""
    told = until(f"{name} is ready ({times})", lambda: lines(engine, name, "ready")[times - 1 :], seconds)
    return float(told[0]["message"].split()[2])


def works(engine: Engine, name: str) -> bool:
    """Does `roughmap health` in its container say so?"""
    try:
        engine.run("exec", name, "roughmap", "health")
    except Failed:
        return False
    return True


def state(engine: Engine, name: str) -> dict[str, Any]:
    """The engine's word on the container."""
    known: dict[str, Any] = engine.inspect(name)["State"]
    return known


def the_image(engine: Engine, covered: Covered) -> None:
    """What is in it and what it says of itself."""
    known = json.loads(engine.run("image", "inspect", engine.image))[0]
    config, size = known["Config"], known["Size"] / 1e6
    expect(config["User"] == "10001:10001", f"user {config['User']}")
    expect(config["Volumes"] == {"/data": {}}, f"volumes {config['Volumes']}")
    expect("org.opencontainers.image.version" in config["Labels"], f"labels {config['Labels']}")
    health = known.get("Healthcheck") or config.get("Healthcheck") or {}
    expect(health.get("Test") == ["CMD", "roughmap", "health"], f"health check {health}")
    compilers = "import shutil; print(*filter(None, map(shutil.which, ('cc', 'gcc', 'clang', 'ld', 'as'))))"
    found = engine.once("-c", compilers, options=PYTHON).strip()
    expect(not found, f"in the image: {found}")
    covered(f"the image: {size:.0f} MB, user 10001, volume /data, health check, OCI labels, no compiler")


def a_refusal(engine: Engine, covered: Covered) -> None:
    """It doesn't open itself to a network in the clear unless it is told to."""
    said = engine.once("serve", "--set", 'zenoh.listen=["tcp/0.0.0.0:7447"]', fails=True)
    expect("--insecure" in said, f"it listens in the clear: {said}")
    covered("beyond loopback without TLS: refused, with the way out named")


def driving(engine: Engine, covered: Covered) -> str:
    """Router, service and rover; tiles from a third container; the pages; the health check."""
    router = ("-v", f"{DOCKER}/router.py:/router.py:ro", "-v", f"{DOCKER}/router.json5:/router.json5:ro")
    engine.start("router", "/router.py", "/router.json5", options=(*router, *PYTHON))
    volume = engine.volume("data")
    options = (*SERVICE, "-v", f"{volume}:/data", "--restart=unless-stopped")
    service = engine.start("map", "serve", "--insecure", options=options)
    took = ready(engine, service)
    expect(state(engine, service)["Running"], "the service runs")
    rest = engine.run("exec", service, "sed", "-n", "s/^VmRSS: *//p", "/proc/1/status").strip()
    covered(
        f"first start on an empty volume: ready after {took:.2f} s; at rest {int(rest.split()[0]) >> 10} MiB resident"
    )
    engine.start("rover", "simulate", "--connect", ROUTER, "--duration", "90", "--columns", "256")
    seen = until("tiles of the rover's ground", lambda: (now := ask(engine))["known_cells"] > 1000 and now)
    covered(f"a third container asks for all tiles: {seen['tiles']}, {seen['known_cells']} known cells")
    expect(works(engine, service), "roughmap health says that it works")
    by_engine = "podman's own" if engine.program == "podman" else "docker's"
    if engine.program == "podman":
        engine.run("healthcheck", "run", service)
    else:
        until("the health check passes", lambda: state(engine, service)["Health"]["Status"] == "healthy", 60)
    covered(f"the health check passes ({by_engine})")
    page = "import urllib.request as u; print(u.urlopen('http://map:8080/metrics', timeout=5).read().decode())"
    metrics = engine.once("-c", page, options=PYTHON)
    expect("roughmap_clouds_accepted_total" in metrics, "the metrics page counts clouds")
    covered("metrics page over the network")
    privileges = engine.run("exec", service, "grep", "-E", "^(Cap(Eff|Bnd)|NoNewPrivs)", "/proc/1/status").split()
    expect(privileges == ["CapEff:", "0" * 16, "CapBnd:", "0" * 16, "NoNewPrivs:", "1"], f"privileges {privileges}")
    try:
        engine.run("exec", service, "touch", "/opt/roughmap/x")
    except Failed:
        covered("read-only root file system, no capabilities, no new privileges, limits on memory and processes")
    else:
        raise Failed("the root file system can be written")
    return volume


def killed(engine: Engine, covered: Covered, service: str, nth: int) -> None:
    """kill -9 of the service's process 1; wait until it is back."""
    engine.kill(service)
    took = ready(engine, service, nth)
    covered(f"kill -9: started again by its restart policy, ready after {took:.2f} s")


def faults(engine: Engine, covered: Covered) -> None:
    """Killed, paused and cut off while the rover drives."""
    service = f"{engine.network.removesuffix('-net')}-map"
    before = ask(engine)
    killed(engine, covered, service, 2)
    after = until("it goes on", lambda: (now := ask(engine))["sequence"] > before["sequence"] and now)
    expect(after["epoch"] > before["epoch"], "a new epoch after the kill")
    covered(f"and goes on: sequence {before['sequence']} before, {after['sequence']} after, epoch {after['epoch']}")

    engine.run("pause", service)
    time.sleep(4)  # the fault itself: the rover publishes on meanwhile
    engine.run("unpause", service)
    after = until("it goes on", lambda: (now := ask(engine))["sequence"] > after["sequence"] + 5 and now)
    covered(f"paused for 4 s: goes on, health {after['health']}")

    engine.run("network", "disconnect", engine.network, service)
    try:
        ask(engine)
    except Failed:
        covered("cut off the network: nobody is answered")
    else:
        raise Failed("answers came over a network that was cut")
    expect(state(engine, service)["Running"], "the service runs while it is cut off")
    engine.run("network", "connect", "--alias", "map", engine.network, service)
    after = until("it is back", lambda: (now := ask(engine))["sequence"] > after["sequence"] + 5 and now)
    covered(f"the network is back: it goes on, sequence {after['sequence']}")


def replay(engine: Engine, volume: str, *arguments: str) -> str:
    """What `roughmap replay` says in a container that has nothing but the volume, to read."""
    alone = ("--network=none", "-v", f"{volume}:/data:ro", "-e", "NUMBA_CACHE_DIR=")
    said = engine.once("replay", *arguments, options=alone, seconds=300).strip().splitlines()[-1]
    expect(said.startswith("equal: "), f"replay says {said!r}")
    return said


def backed_up(engine: Engine, covered: Covered) -> None:
    """OPERATIONS.md's backup, while the rover drives; restored, it is a map of its own that goes on."""
    service = f"{engine.network.removesuffix('-net')}-map"
    until("a snapshot is stored", lambda: lines(engine, service, "snapshot"))
    copy = (
        'umask 027 && python -c \'import sqlite3 as s; s.connect("/data/map.db").backup(s.connect("/backup/map.db"))\''
        " && mkdir /backup/log && cp /data/log/*.mcap /backup/log/"
    )
    data, volume = f"{service.removesuffix('-map')}-data", engine.volume("backup")
    with TemporaryDirectory(prefix="roughmap-") as folder:
        os.chown(folder, 10001, 10001)
        mounts = ("-v", f"{data}:/data", "-v", f"{folder}:/backup")
        engine.once("-c", copy, options=(*mounts, "--entrypoint", "sh"))
        open_ = [path for path in Path(folder).rglob("*") if path.is_file() and path.stat().st_mode & 0o007]
        expect(not open_, f"everybody may read of the backup: {open_}")
        mounts = ("-v", f"{volume}:/data", "-v", f"{folder}:/backup:ro")
        engine.once("-r", "/backup/map.db", "/backup/log", "/data/", options=(*mounts, "--entrypoint", "cp"))
    options = (*SERVICE, "-v", f"{volume}:/data", "--network=none", "-e", "ROUGHMAP_ZENOH__CONNECT=")
    options = (*options, "-e", "ROUGHMAP_ZENOH__MODE=peer")
    restored = engine.start("restored", "serve", "--insecure", options=options, network=False)
    ready(engine, restored)
    (back,) = lines(engine, restored, "map_recovered")
    engine.run("stop", "-t", "12", restored)
    covered(f"backup while it runs, restored in a fresh container at sequence {back['sequence']}")
    covered(f"and the backup replays: {replay(engine, volume, '/data/log')}")


def replayed(engine: Engine, covered: Covered, volume: str) -> None:
    """The rover has ended: the same digest after a kill, at a stop, and from the log in a fresh container."""
    service, rover = (f"{engine.network.removesuffix('-net')}-{name}" for name in ("map", "rover"))
    until("the rover's drive ends", lambda: not state(engine, rover)["Running"], 240)
    expect(state(engine, rover)["ExitCode"] == 0, "the rover ended well")
    served = until("the map is still", lambda: (now := ask(engine))["sequence"] == ask(engine)["sequence"] and now)
    starts = len(lines(engine, service, "ready"))
    killed(engine, covered, service, starts + 1)
    again = ask(engine)
    same = {name: again[name] == served[name] for name in ("digest", "sequence", "tiles", "known_cells")}
    expect(all(same.values()), f"after the kill: {again}, before: {served}")
    covered(
        f"kill -9 at rest: the same digest {again['digest']} of {again['tiles']} tiles, sequence {again['sequence']}"
    )

    kernels = engine.run("exec", service, "find", "/data/kernels", "-name", "*.nbc")
    expect(not kernels, f"kernels that the image lacks were compiled: {kernels}")
    covered("all kernels came with the image: none was compiled")

    engine.run("stop", "-t", "12", service)
    ended = lines(engine, service, "end")
    expect(state(engine, service)["ExitCode"] == 0 and ended, f"stopped: {state(engine, service)}")
    covered("SIGTERM to process 1: ended in order, exit 0")
    alone = ("--network=none", "-v", f"{volume}:/data:ro", "-e", "NUMBA_CACHE_DIR=")
    said = engine.once("replay", "/data/log", options=alone, seconds=300).strip().splitlines()[-1]
    expect(
        said.startswith("equal: ") and again["digest"] in said, f"replay says {said!r}; served was {again['digest']}"
    )
    covered(f"replayed from the volume, read-only, in a fresh container without a network: {said}")


@contextmanager
def small_disk() -> Iterator[Path]:
    """A file system of `FILLED` bytes, in memory, that belongs to the image's user."""
    with TemporaryDirectory(prefix="roughmap-") as folder:
        options = f"size={FILLED},uid=10001,gid=10001,mode=0750"
        subprocess.run(["mount", "-t", "tmpfs", "-o", options, "roughmap-test", folder], check=True)
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", "--lazy", folder], check=True)


def fill(path: Path) -> None:
    """Write to a file until not another byte fits."""
    left = 1 << 16
    with path.open("wb", buffering=0) as file:
        while left:
            try:
                file.write(bytes(left))
            except OSError:
                left >>= 1


def full(engine: Engine, covered: Covered, disk: Path) -> None:
    """A volume without room: it says so, refuses what it can't keep, answers on, and goes on once there is room."""
    options = (*SERVICE, "-v", f"{disk}:/data", "--restart=unless-stopped")
    service = engine.start("full", "serve", "--insecure", options=options)
    ready(engine, service)
    engine.start("rover2", "simulate", "--connect", ROUTER, "--duration", "40", "--columns", "64", "--rings", "32")
    before = until("tiles", lambda: (now := ask(engine))["known_cells"] > 100 and now)
    fill(disk / "filler")
    told = until("it says that the log can't be written", lambda: not (now := ask(engine))["log_ok"] and now)
    expect(told["health"] == "degraded" and told["known_cells"] >= before["known_cells"], f"on a full volume: {told}")
    expect(not works(engine, service), "health on a full volume")
    expect(state(engine, service)["Running"], "the service runs on a full volume")
    covered(f"a full volume: degraded, health fails, {told['tiles']} tiles are answered, refused: {told['refused']}")
    (disk / "filler").unlink()
    now = until("it goes on", lambda: (now := ask(engine))["log_ok"] and now["sequence"] > told["sequence"] and now)
    expect(works(engine, service), "health once there is room")
    covered(f"room again: health {now['health']}, sequence {told['sequence']} to {now['sequence']}")
    engine.run("stop", "-t", "12", service)
    expect(state(engine, service)["ExitCode"] == 0, "ended in order")
    covered(f"the log that met a full disk replays: {replay(engine, str(disk), '/data/log')}")


def another_cpu(engine: Engine, covered: Covered) -> None:
    """On a CPU that the kernels were not built for, they are compiled once, into the volume."""
    volume = engine.volume("other")
    options = (*SERVICE, "-v", f"{volume}:/data", "-e", "NUMBA_CPU_NAME=generic", "-e", "NUMBA_CPU_FEATURES=")
    options = (*options, "-e", "ROUGHMAP_MAP__NAME=other")
    service = engine.start("other", "serve", "--insecure", options=options)
    first = ready(engine, service, seconds=400)
    engine.run("stop", "-t", "12", service)
    engine.run("start", service)
    second = ready(engine, service, 2)
    expect(second < first / 3, f"ready after {first:.1f} s, then {second:.1f} s")
    covered(f"another CPU (a generic one): {first:.0f} s at the first start, kept in the volume, then {second:.2f} s")


def main() -> int:
    """All of it."""
    found = subprocess.run(["bash", "-c", f". {DOCKER}/engine && env -0"], capture_output=True, text=True, check=False)
    if found.returncode:
        print(found.stderr, file=sys.stderr)
        return 2
    os.environ.update(pair.split("=", 1) for pair in found.stdout.split("\0") if "=" in pair)
    covered = Covered()
    program = os.environ["ENGINE"]
    if os.geteuid() != 0:
        print(
            "kill -9 of another user's process and a volume in memory need root: sudo make container-test",
            file=sys.stderr,
        )
        return 2
    try:
        with Engine(program, os.environ.get("ROUGHMAP_IMAGE", "localhost/roughmap:latest")) as engine:
            the_image(engine, covered)
            a_refusal(engine, covered)
            volume = driving(engine, covered)
            backed_up(engine, covered)
            faults(engine, covered)
            replayed(engine, covered, volume)
            with small_disk() as disk:
                full(engine, covered, disk)
            another_cpu(engine, covered)
    except Failed as error:
        print(f"FAILED after {len(covered.items)} steps: {error}", file=sys.stderr)
        return 1
    version = subprocess.run([program, "--version"], capture_output=True, text=True, check=False).stdout.strip()
    print(f"\ncontainer test passed with {version}; it covered:")
    for item in covered.items:
        print(f"  - {item}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
