"""`roughmap serve` and `roughmap replay` as processes, by the command line alone: every version has that."""

import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Self

READY_S = 900.0
"""A first start compiles all kernels, perhaps on a slow and busy machine."""

STOP_S = 30.0
REPLAY_S = 600.0
COMMAND = (sys.executable, "-m", "roughmap_service.cli.main")


def environment() -> dict[str, str]:
    """This environment without settings that would change the service."""
    return {name: value for name, value in os.environ.items() if not name.startswith("ROUGHMAP_")}


class ServiceProcess:
    """A `roughmap serve` that is ready and listens on `endpoints`; a context manager that kills it if it still runs.

    ``errors``: the file for its standard error.
    """

    def __init__(self, config: Path, errors: Path) -> None:
        self.endpoints: list[str] = []
        self._errors = errors
        with errors.open("w") as stream:
            self._process = subprocess.Popen(
                [*COMMAND, "serve", "-c", str(config)],
                stdout=subprocess.PIPE, stderr=stream, text=True, env=environment(),
            )  # fmt: skip

    def __enter__(self) -> Self:
        lines: list[str] = []
        assert self._process.stdout is not None
        reader = threading.Thread(target=lambda out=self._process.stdout: lines.append(out.readline()), daemon=True)
        reader.start()
        reader.join(READY_S)
        if not lines or not lines[0]:
            self.__exit__()
            raise RuntimeError(f"the service was not ready: {last_line(self._errors)}")
        self.endpoints = json.loads(lines[0])["endpoints"]
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait(STOP_S)
        assert self._process.stdout is not None
        self._process.stdout.close()

    def cpu_s(self) -> float:
        """CPU time that all its threads have taken since it was started, seconds."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")  # utime, stime

    def stop(self) -> None:
        """Stop it in order; RuntimeError if it doesn't end well."""
        self._process.terminate()
        if self._process.wait(STOP_S) != 0:
            raise RuntimeError(f"the service did not end well: {last_line(self._errors)}")


def replay(log: Path) -> None:
    """Integrate a log again; RuntimeError unless the results are equal."""
    done = subprocess.run(
        [*COMMAND, "replay", str(log)], capture_output=True, text=True, env=environment(), timeout=REPLAY_S, check=False
    )
    if done.returncode != 0:
        said = (done.stdout.strip() or done.stderr.strip()).splitlines()
        raise RuntimeError(f"the log does not replay: {said[-1] if said else 'no output'}")


def last_line(errors: Path) -> str:
    """The last line of a file of standard error, where commands print the cause."""
    lines = errors.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else "no message"
