"""The processes of the demo: service, rover and replay."""

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

from roughmap_service.cli.options import Failure

READY_S = 900.0
"""Seconds: a first start compiles all kernels, perhaps on a slow and busy machine."""

COMPILING = '"event": "compiling"'
"""In the service's log lines while it compiles its kernels."""

STOP_S = 30.0
REPLAY_S = 600.0


def command(*arguments: str) -> list[str]:
    """Return a `roughmap` command line that this Python runs, whatever is in PATH."""
    return [sys.executable, "-m", "roughmap_service.cli.main", *arguments]


def environment() -> dict[str, str]:
    """Return this environment without ROUGHMAP_ variables, which would change the demo's service."""
    return {name: value for name, value in os.environ.items() if not name.startswith("ROUGHMAP_")}


class _Process:
    """A child process whose stderr goes to a file; terminated at the end if it still runs."""

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
        """Return the last line of stderr, where roughmap commands print the cause."""
        lines = self._errors.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else f"no message, see {self._errors}"


class ServiceProcess(_Process):
    """A `roughmap serve` that is ready and listens on `endpoints`; ``compiling`` is called if it compiles kernels."""

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
                raise Failure(f"the service stopped before it was ready: {self.last_words()}")
            self.endpoints = json.loads(line)["endpoints"]
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def _ready_line(self, lines: "queue.Queue[str]") -> str:
        until, reported = time.monotonic() + READY_S, False
        while time.monotonic() < until:
            with contextlib.suppress(queue.Empty):
                return lines.get(timeout=1.0)
            if not reported and COMPILING in self._errors.read_text(errors="replace"):
                reported = True
                self._compiling()
        last = self.last_words()
        raise Failure(
            f"the service was not ready within {READY_S:g} s; try again, since compiled kernels are kept ({last})"
        )

    def stop(self) -> int:
        """Send SIGTERM; return the exit code."""
        self.process.terminate()
        try:
            return self.process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            raise Failure(f"the service did not stop within {STOP_S:g} s of SIGTERM") from None


class RoverProcess(_Process):
    """A `roughmap simulate` in real time."""

    def __init__(
        self, endpoints: list[str], seconds: float, robots: int, seed: int, start_ns: int, errors: Path
    ) -> None:
        connect = [part for endpoint in endpoints for part in ("--connect", endpoint)]
        self._duration = seconds
        drive = ["--duration", str(seconds), "--robots", str(robots), "--seed", str(seed), "--start-ns", str(start_ns)]
        super().__init__(command("simulate", *connect, *drive, "--json"), errors)

    def wait(self, seconds: float, driven: Callable[[float], None]) -> dict[str, Any]:
        """Wait for the end; return what was published. `driven` is called with the seconds driven so far."""
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


def replay(log_directory: Path, errors: Path) -> tuple[int, str]:
    """Run `roughmap replay`; return its exit code and last line."""
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
    return 1, f"not finished within {REPLAY_S:g} s"
