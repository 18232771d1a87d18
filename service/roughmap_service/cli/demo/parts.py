"""The processes and the thread of the demo: the service, the rover, the planner, the replay."""

import contextlib
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np

from roughmap_client import RoughMapClient
from roughmap_client.errors import RoughMapError
from roughmap_service.cli.options import Failure
from roughmap_service.simulation.rover import Rover

READY_S = 900.0
"""A first start compiles all kernels on what may be a slow and busy machine."""

COMPILING = '"event": "compiling"'
"""By this the service's log says why its start takes long."""

STOP_S = 30.0
REPLAY_S = 600.0

QUERY_HZ = 5.0
QUERY_SIDE_M = 20.0
QUERY_LAYERS = ["mean_height", "slope", "step_height", "traversability"]


def command(*arguments: str) -> list[str]:
    """A `roughmap` command line, run by this Python, whatever the PATH holds."""
    return [sys.executable, "-m", "roughmap_service.cli.main", *arguments]


def environment() -> dict[str, str]:
    """This environment without settings that would reach into the demo's service."""
    return {name: value for name, value in os.environ.items() if not name.startswith("ROUGHMAP_")}


class _Process:
    """A child whose standard error goes to a file; killed if it is still there at the end."""

    def __init__(self, arguments: list[str], errors: Path) -> None:
        self._errors = errors
        with errors.open("w") as stream:
            self.process = subprocess.Popen(  # noqa: S603  # nosec B603  # our own command line
                arguments, stdout=subprocess.PIPE, stderr=stream, text=True, env=environment()
            )

    @property
    def stdout(self) -> IO[str]:
        assert self.process.stdout is not None  # noqa: S101  # it is a pipe
        return self.process.stdout

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        self.stdout.close()

    def last_words(self) -> str:
        """The last line of standard error: the cause, as our commands print it."""
        lines = self._errors.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else f"no message, see {self._errors}"


class ServiceProcess(_Process):
    """`roughmap serve` until it is ready; `endpoints` is where it listens. ``compiling`` is called if it compiles."""

    def __init__(self, config: Path, errors: Path, compiling: Callable[[], None] = lambda: None) -> None:
        super().__init__(command("serve", "-c", str(config)), errors)
        self.endpoints: list[str] = []
        self._compiling = compiling

    def __enter__(self) -> Self:
        lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=lambda: lines.put(self.stdout.readline()), name="ready line", daemon=True).start()
        try:
            line = self._ready_line(lines)
            if not line:
                self.process.wait(STOP_S)
                raise Failure(f"the service ended before it was ready: {self.last_words()}")
            self.endpoints = json.loads(line)["endpoints"]
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def _ready_line(self, lines: "queue.Queue[str]") -> str:
        until, told = time.monotonic() + READY_S, False
        while time.monotonic() < until:
            with contextlib.suppress(queue.Empty):
                return lines.get(timeout=1.0)
            if not told and COMPILING in self._errors.read_text(errors="replace"):
                told = True
                self._compiling()
        last = self.last_words()
        raise Failure(
            f"the service was not ready within {READY_S:g} s; run it again: what was compiled is kept ({last})"
        )

    def stop(self) -> int:
        """SIGTERM; returns the exit code."""
        self.process.terminate()
        try:
            return self.process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            raise Failure(f"the service did not end within {STOP_S:g} s of SIGTERM") from None


class RoverProcess(_Process):
    """`roughmap simulate`, at real time."""

    def __init__(
        self, endpoints: list[str], seconds: float, robots: int, seed: int, start_ns: int, errors: Path
    ) -> None:
        connect = [part for endpoint in endpoints for part in ("--connect", endpoint)]
        self._duration = seconds
        drive = ["--duration", str(seconds), "--robots", str(robots), "--seed", str(seed), "--start-ns", str(start_ns)]
        super().__init__(command("simulate", *connect, *drive, "--json"), errors)

    def wait(self, seconds: float, driven: Callable[[float], None]) -> dict[str, Any]:
        """What was published, in how many seconds; `driven` hears now and then for how long the rover has driven."""
        begun = time.monotonic()
        while True:
            try:
                text, _ = self.process.communicate(timeout=0.5)
                break
            except subprocess.TimeoutExpired:
                elapsed = time.monotonic() - begun
                if elapsed > seconds:
                    raise Failure(f"the rover did not stop within {seconds:g} s") from None
                driven(min(elapsed, self._duration))
        if self.process.returncode != 0:
            raise Failure(f"the rover failed: {self.last_words()}")
        counts: dict[str, Any] = json.loads(text)
        return counts


class Planner:
    """Asks for the ground around the rover while it drives, in a thread; a context manager."""

    def __init__(self, client: RoughMapClient, rover: Rover) -> None:
        self.latencies: list[float] = []
        self.errors: list[str] = []
        self.worst_lag: tuple[float, float] | None = None
        """Arrival to queryable, p50 and p99, as the service said them at its worst; None before it said any."""
        self._client = client
        self._rover = rover
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="planner")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        count = 0
        begun: float | None = None
        while not self._stop.wait(1 / QUERY_HZ):
            elapsed = 0.0 if begun is None else time.monotonic() - begun
            x, y = self._rover.pose(np.array([self._rover.start_ns + round(elapsed * 1e9)])).position[0, :2]
            half = QUERY_SIDE_M / 2
            try:
                asked = time.perf_counter()
                region = self._client.region((x - half, y - half, x + half, y + half), QUERY_LAYERS)
                answered = time.perf_counter()
                if region.sequence == 0:
                    continue  # nothing has been scanned yet: an answer without work would flatter the figures
                self.latencies.append(answered - asked)
                begun = time.monotonic() if begun is None else begun
                count += 1
                if count % int(QUERY_HZ) == 0:
                    self._note_lag()
            except RoughMapError as error:
                self.errors.append(f"{type(error).__name__}: {error}")

    def _note_lag(self) -> None:
        lag = self._client.status().lag_s
        if lag.p99 is not None and lag.p50 is not None and (self.worst_lag is None or lag.p99 > self.worst_lag[1]):
            self.worst_lag = (lag.p50, lag.p99)


def replay(log_directory: Path, errors: Path) -> tuple[int, str]:
    """`roughmap replay`: exit code and last line."""
    with errors.open("w") as stream, contextlib.suppress(subprocess.TimeoutExpired):
        done = subprocess.run(  # noqa: S603  # nosec B603  # our own command line
            command("replay", str(log_directory)),
            stdout=subprocess.PIPE,
            stderr=stream,
            text=True,
            env=environment(),
            timeout=REPLAY_S,
            check=False,
        )
        lines = done.stdout.strip().splitlines() or errors.read_text(errors="replace").strip().splitlines()
        return done.returncode, lines[-1] if lines else "no output"
    return 1, f"no answer within {REPLAY_S:g} s"
