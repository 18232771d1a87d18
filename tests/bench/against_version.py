"""A version of roughmap: its sources, and the fresh processes that measure it."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from roughmap_commands import environment, last_line

ROOT = Path(__file__).resolve().parents[2]
JOBS = Path(__file__).with_name("against_jobs.py")
GIT_S = 120.0


class Failed(Exception):
    """A process gave no values; why."""


@dataclass(frozen=True)
class Version:
    """``tree``: its sources. ``folder``: its own, for compiled kernels and whatever a process leaves."""

    name: str
    tree: Path
    folder: Path

    def measure(self, job: str, limit_s: float, **given: Any) -> dict[str, Any]:
        """What `against_jobs.py` says of ``job``; `Failed` if it says nothing, or not within ``limit_s``.

        The process and all that it started are gone then, in any case.
        """
        paths = [self.tree, self.tree / "service", self.tree / "schemas"]
        own = {"PYTHONPATH": os.pathsep.join(map(str, paths)), "NUMBA_CACHE_DIR": str(self.folder / "kernels")}
        self.folder.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self.folder, prefix=f"{job}-", ignore_cleanup_errors=True) as work:
            errors = Path(work) / "errors.txt"
            options = json.dumps({"job": job, "tree": str(self.tree), "work": work, **given})
            process = None
            try:
                with errors.open("w") as stream, signals_held_back():
                    process = subprocess.Popen(
                        [sys.executable, str(JOBS), options], cwd=work, env=environment() | own, stdout=subprocess.PIPE,
                        stderr=stream, text=True, start_new_session=True,
                    )  # fmt: skip
                text, _ = process.communicate(timeout=limit_s)
            except subprocess.TimeoutExpired:
                raise Failed(f"not done within {limit_s:g} s") from None
            finally:
                if process is not None:
                    _end(process)
            if process.returncode != 0:
                raise Failed(last_line(errors)[:200])
        made: dict[str, Any] = json.loads(text)
        return made


def _end(process: subprocess.Popen[str]) -> None:
    """Kill its session, in which its services and askers are, too."""
    with signals_held_back():
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


@contextmanager
def signals_held_back() -> Iterator[None]:
    """SIGINT and SIGTERM take effect after the block: in the midst of it they would leave something behind."""
    came: list[int] = []
    before = {number: signal.signal(number, lambda n, _: came.append(n)) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in came[:1]:
            signal.raise_signal(number)


def git(*arguments: str) -> str:
    """What git says of this repository; CalledProcessError if it fails."""
    done = subprocess.run(
        ["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, timeout=GIT_S, check=True
    )
    return done.stdout.strip()


@contextmanager
def checked_out(commit: str, folder: Path) -> Iterator[Path]:
    """The sources of a commit, in a git worktree of which nothing is left at the end.

    Kernels that are compiled beside this tree's sources come along. Those of other sources are not used: their digest
    is part of a kernel's stamp.
    """
    tree = folder / "tree"
    try:
        with signals_held_back():
            git("worktree", "add", "--quiet", "--detach", str(tree), commit)
        for kernel in ROOT.joinpath("roughmap").rglob("__pycache__/*.nb[ic]"):
            copy = tree / kernel.relative_to(ROOT)
            if copy.parents[1].is_dir():
                copy.parent.mkdir(exist_ok=True)
                shutil.copy(kernel, copy)
        yield tree
    finally:
        with signals_held_back(), suppress(subprocess.CalledProcessError):
            git("worktree", "remove", "--force", str(tree))
