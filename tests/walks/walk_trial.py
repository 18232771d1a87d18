"""A walk: several robots with one fault each, at the same time, against one service; who named it, and how soon.

The robots drive well for a while. Then doctor is started, the faults begin, and last they end again.
"""

import json
import re
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import walks_paths  # noqa: F401 - before what it makes importable
import zenoh
from net import WAIT_S, peer_config
from processes import COMMAND, Service, environment
from walk_fault import Names
from walk_sender import Sender, Walk, settings

from roughmap_client import RoughMapClient
from roughmap_schemas import IntegrationEvent, MapStatus, decode_event

WELL_S = 5.0
"""Seconds of good messages before a fault: until the sensors' clocks are known."""

WELL_CLOUDS = 40
"""Clouds of a robot that must be in the map by then, so that each of its sensors has its ten."""

LISTEN_S = 6.0
"""How long doctor listens."""

SEEN_S, LONGER_S = 5.0, 10.0
"""How long it has listened when a fault begins of which it must see the beginning, and how long it listens then. It
says that it listens some seconds early on a busy machine."""

TOGETHER = 8
"""Robots that walk at the same time."""

POLL_S = 0.2

NEAR_S = 0.5
"""How far a time_offset may be from the right one, with latencies of a tenth of a second on a busy machine."""


class Doctor(threading.Thread):
    """`roughmap doctor` beside a running service, as a process. ``listens`` and ``done`` are wall seconds."""

    def __init__(self, service: Service, endpoint: str, seconds: float) -> None:
        super().__init__(daemon=True)
        self._process = subprocess.Popen(
            [
                *COMMAND, "doctor", "-c", str(service.directory / "roughmap.toml"), "--json", "--seconds", str(seconds),
                "--set", f'zenoh.listen=["{endpoint}"]',
            ],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment(),
        )  # fmt: skip
        self.listening = threading.Event()
        self.listens = self.done = 0.0
        self.findings: list[dict[str, str]] = []
        self.error = ""
        self.start()

    def run(self) -> None:
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        for line in self._process.stderr:
            if "listening for" in line:
                self.listens = time.time()
                self.listening.set()
            else:
                self.error += line
        out = self._process.stdout.read()
        self.done = time.time()
        self.listening.set()
        self._process.wait(WAIT_S)
        if out:
            self.findings = json.loads(out)["findings"]

    def kill(self) -> None:
        """End it, if it still runs."""
        if self._process.poll() is None:
            self._process.kill()
        self.join(WAIT_S)
        for pipe in (self._process.stdout, self._process.stderr):
            assert pipe is not None
            pipe.close()


class Batch:
    """Robots that walk at the same time."""

    def __init__(self, service: Service, endpoint: str, session: zenoh.Session, walks: Sequence[Walk]) -> None:
        self.service, self.endpoint, self.session, self.walks = service, endpoint, session, walks
        self.by_name = {walk.name: walk for walk in walks}
        self.client = RoughMapClient("site", session=session, timeout=WAIT_S)
        self.first_line = len(service.err)
        self._looked_at = self.first_line

    def go(self, limit: float) -> None:
        """Walk; wait at most ``limit`` seconds for each to be named, and for each problem to end."""
        with ExitStack() as stack:
            subscriber = self.session.declare_subscriber("maps/site/events", self._event)
            stack.callback(subscriber.undeclare)
            for walk in self.walks:
                walk.silent = walk.kind.begins == "first"
            sender = Sender(self.session, self.walks)
            stack.callback(sender.stop)
            sender.start()
            well = time.monotonic()
            self._wait(lambda: time.monotonic() > well + WELL_S and self._all_well(), WAIT_S, "robots to be mapped")
            sees_begin = any(walk.kind.begins == "meanwhile" for walk in self.walks)
            listens_s = LONGER_S if sees_begin else LISTEN_S
            doctor = Doctor(self.service, self.endpoint, listens_s)
            stack.callback(doctor.kill)
            self._begin("first", "before")
            self._wait(doctor.listening.is_set, WAIT_S, "doctor to listen")
            if sees_begin:
                self._wait(lambda: time.time() > doctor.listens + SEEN_S, WAIT_S, "doctor to hear robots")
                self._begin("meanwhile")
            self._wait(lambda: bool(doctor.done) and not doctor.is_alive(), listens_s + WAIT_S, "doctor")
            self._judge_doctor(doctor)
            with_time = lambda: time.time() > max(walk.begun for walk in self.walks) + limit  # noqa: E731
            named = lambda: not any({"log", "health"} & {*walk.missing()} for walk in self.walks)  # noqa: E731
            self._wait(lambda: named() or with_time(), limit + WAIT_S, "log and health")
            for walk in self.walks:
                walk.on, walk.ended = False, time.time()
            over = time.time() + limit
            self._wait(lambda: not any(walk.missing() == ["end"] for walk in self.walks) or time.time() > over,
                       limit + WAIT_S, "problems to end")  # fmt: skip
            for walk in self.walks:
                walk.silent = True

    def _begin(self, *when: str) -> None:
        for walk in self.walks:
            if walk.kind.begins in when:
                walk.begin()

    def _all_well(self) -> bool:
        return all(walk.integrated >= WELL_CLOUDS for walk in self.walks if not walk.silent)

    def _event(self, sample: zenoh.Sample) -> None:
        event = decode_event(sample.payload.to_bytes())
        if isinstance(event, IntegrationEvent) and event.outcome == "integrated" and event.robot in self.by_name:
            self.by_name[event.robot].integrated += 1

    def _wait(self, until: Callable[[], bool], seconds: float, what: str) -> None:
        """Look at log and status until something is so."""
        limit = time.monotonic() + seconds
        while True:
            self._look()
            if until():
                return
            if time.monotonic() > limit:
                raise TimeoutError(f"waited {seconds:g} s in vain for {what}")
            time.sleep(POLL_S)

    def _look(self) -> None:
        lines = self.service.err[self._looked_at :]
        self._looked_at += len(lines)
        for text in lines:
            self._judge_line(json.loads(text))
        self._judge_status(self.client.status())

    def _judge_line(self, line: dict[str, Any]) -> None:
        walk = self.by_name.get(str(line.get("robot")))
        if walk is None or walk.fault.names.log is None or not walk.begun or walk.told.log is not None:
            return
        head, words = walk.fault.names.log
        if line.get("level") != "info":
            walk.told.said.setdefault("log", f"{line.get('event')} {line.get('reason')}: {line['message']}")
        said = f"{line.get('event')} {line.get('reason', '')}".strip()
        if re.match(rf"{head}( |$)", said) and named(walk.fault.names, words, line["message"]):
            walk.told.log = datetime.fromisoformat(line["time"]).timestamp() - walk.begun
            walk.told.said["log"] = line["message"]

    def _judge_status(self, status: MapStatus) -> None:
        now = time.time()
        for walk in self.walks:
            names, told = walk.fault.names, walk.told
            sentence = status.problems.get(walk.subject, "")
            if not names.lasting:
                sentence = "\n".join(line for line in status.recent if line.startswith(f"{walk.subject}: "))
            if walk.on and sentence:
                if names.health and told.health is None and named(names, names.health, sentence):
                    told.health, told.said["health"] = now - walk.begun, sentence
                told.said.setdefault("health", sentence)
            mine = {s: t for s, t in status.problems.items() if s == walk.robot or s.startswith(f"{walk.robot} ")}
            for subject, text in mine.items():
                if not self._may_be(walk, subject) and not any(one.startswith(subject) for one in told.wrong):
                    told.wrong.append(f"{subject} in problems: {text}")
            if walk.ended and told.ended is None and told.health is not None:
                told.said["ended"] = "; ".join(mine.values())
                if not mine:
                    told.ended = now - walk.ended
            if mine and status.health != "degraded":
                told.wrong.append(f"health is {status.health} with problems")

    def _may_be(self, walk: Walk, subject: str) -> bool:
        """Whether this may be a problem: that of the fault, or what follows from it. After the end, what ends it."""
        names = walk.fault.names
        if names.health and names.lasting and (subject == walk.subject or walk.ended):
            return True
        return walk.kind.costs == "sensors" and subject.startswith(walk.robot)

    def _judge_doctor(self, doctor: Doctor) -> None:
        if not doctor.findings:
            raise RuntimeError(f"doctor found nothing: {doctor.error}")
        for walk in self.walks:
            names = walk.fault.names
            mine = [f for f in doctor.findings if f["area"] == walk.name or f["area"].startswith(walk.robot)]
            wrong = [f for f in mine if f["verdict"] == "wrong"]
            for finding in mine:
                advice = f"{finding['remedy']}\n{finding['settings']}".strip()
                strict = finding["verdict"] == names.verdict or finding["verdict"] == "wrong"
                said = re.search(names.doctor, finding["text"])
                if names.doctor and strict and said and named(names, names.advice, advice):
                    walk.told.doctor = doctor.done - max(walk.begun, doctor.listens)
                    walk.told.said["doctor"] = f"{finding['text']} -> {advice}"
                    walk.told.settings = finding["settings"]
                    break
            else:
                texts = [f"{f['verdict']} {f['area']}: {f['text']} -> {f['remedy']} {f['settings']}" for f in mine]
                walk.told.said["doctor"] = "; ".join(texts)
            if not names.doctor and wrong:
                walk.told.wrong += [f"doctor: {finding['text']}" for finding in wrong]


def named(names: Names, words: str, text: str) -> bool:
    """Whether a text has the words, and the right time_offset if it has any."""
    offsets = [float(number) for number in re.findall(r"time_offset = (-?[\d.]+\d)", text)]
    return bool(re.search(words, text)) and all(abs(one - names.time_offset) < NEAR_S for one in offsets)


@contextmanager
def connected_to(starting: Service) -> Iterator[tuple[Service, str, zenoh.Session]]:
    """A service once it is ready, its endpoint and a session with it."""
    with ExitStack() as stack:
        service = stack.enter_context(starting)
        (endpoint,) = service.ready()["endpoints"]
        session = stack.enter_context(zenoh.open(peer_config(connect=[endpoint])))
        yield service, endpoint, session


def batches(walks: Sequence[Walk]) -> list[list[Walk]]:
    """At most `TOGETHER` each; those whose beginning doctor must see by themselves."""
    found = []
    for meanwhile in (True, False):
        some = [walk for walk in walks if (walk.kind.begins == "meanwhile") == meanwhile]
        found += [some[first : first + TOGETHER] for first in range(0, len(some), TOGETHER)]
    return found


def walk_all(folder: Path, walks: Sequence[Walk], limit: float, say: Callable[[str], None]) -> None:
    """Let the robots walk, `TOGETHER` at a time, beside one service; wait ``limit`` s for each to be named."""
    with connected_to(Service(folder, **settings([walk.name for walk in walks]))) as (service, endpoint, session):
        for batch in batches(walks):
            say(", ".join(walk.name for walk in batch))
            Batch(service, endpoint, session, batch).go(limit)
        assert service.stop() == 0, service.err[-3:]
