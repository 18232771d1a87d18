"""Docker or podman, as the container test uses it: one network, containers and volumes with a prefix of their own, all
removed at the end, whatever happens."""

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

PREFIX = f"roughmap-test-{os.getpid()}"

HARDENED = ("--read-only", "--cap-drop=all", "--security-opt=no-new-privileges", "--memory=1g", "--pids-limit=200")
"""What every container of ours runs under."""


class Failed(Exception):
    """A command or an expectation failed; one line, and what the command said."""


class Engine:
    """The engine's command line. A context manager that removes what it made."""

    def __init__(self, program: str, image: str) -> None:
        self.program = program
        self.image = image
        self.network = f"{PREFIX}-net"
        self._volumes: list[str] = []
        self._containers: list[str] = []

    def __enter__(self) -> Self:
        self.run("network", "create", self.network)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            for name in self._containers:
                print(f"--- the last lines of {name}:\n{self._try('logs', '--tail=15', name)}")
        for name in self._containers:
            self._try("unpause", name)
            self._try("rm", "-f", "-v", name)
        for name in self._volumes:
            self._try("volume", "rm", "-f", name)
        self._try("network", "rm", self.network)

    def run(self, *arguments: str, seconds: float = 120, given: str | None = None, fails: bool = False) -> str:
        """Run a command of the engine; what it printed. Failed if it fails, or if it doesn't although ``fails``."""
        done = subprocess.run(
            [self.program, *arguments], input=given, capture_output=True, text=True, timeout=seconds, check=False
        )
        if (done.returncode != 0) is not fails:
            raise Failed(f"{self.program} {' '.join(arguments)}: exit {done.returncode}\n{done.stdout}{done.stderr}")
        return done.stdout + done.stderr if fails else done.stdout

    def _try(self, *arguments: str) -> str:
        done = subprocess.run([self.program, *arguments], capture_output=True, text=True, timeout=60, check=False)
        return done.stdout + done.stderr

    def volume(self, name: str) -> str:
        """Make a volume; its full name."""
        full = f"{PREFIX}-{name}"
        self.run("volume", "create", full)
        self._volumes.append(full)
        return full

    def start(self, name: str, *command: str, options: tuple[str, ...] = (), network: bool = True) -> str:
        """Start a container of the image in the background, hardened; its full name."""
        full = f"{PREFIX}-{name}"
        net = ("--network", self.network, "--network-alias", name) if network else ()
        self.run("run", "-d", "--name", full, *net, *HARDENED, *options, self.image, *command)
        self._containers.append(full)
        return full

    def once(
        self,
        *command: str,
        options: tuple[str, ...] = (),
        given: str | None = None,
        seconds: float = 120,
        fails: bool = False,
    ) -> str:
        """Run the image once, hardened, on the network; what it printed."""
        net = () if any(option.startswith("--network") for option in options) else ("--network", self.network)
        arguments = ("run", "--rm", "-i", *net, *HARDENED, *options, self.image, *command)
        return self.run(*arguments, seconds=seconds, given=given, fails=fails)

    def inspect(self, name: str) -> dict[str, Any]:
        """What the engine knows of a container."""
        known: list[dict[str, Any]] = json.loads(self.run("container", "inspect", name))
        return known[0]

    def logs(self, name: str) -> list[dict[str, Any]]:
        """The service's log lines, which are JSON, and its line on stdout."""
        text = self._try("logs", name)
        return [json.loads(line) for line in text.splitlines() if line.startswith("{")]

    def kill(self, name: str) -> None:
        """kill -9 of its process 1 from outside, as the kernel does where memory is short."""
        os.kill(int(self.inspect(name)["State"]["Pid"]), signal.SIGKILL)


def until(what: str, holds: Callable[[], Any], seconds: float = 60) -> Any:
    """Ask again until ``holds`` gives something true, and return that; Failed when the time is over."""
    end, last = time.monotonic() + seconds, ""
    while time.monotonic() < end:
        try:
            if found := holds():
                return found
        except Failed as error:
            last = f": {error}"
        time.sleep(0.2)  # between questions to another program, which tells nobody when it is done
    raise Failed(f"not within {seconds:g} s: {what}{last}")
