"""The journal of what processes that die do to their disk."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from cut_states import Call, read_journal
from shim import Shim

DIES = 9
"""The exit code of a step that ends as a kill would end it."""


def journal_of(shim: Shim, *steps: Callable[[Path], None]) -> list[Call]:
    """What processes that run the steps one after the other do to the disk."""
    for step in steps:
        code = f"import {step.__module__} as t, pathlib; t.{step.__name__}(pathlib.Path({str(shim.root / 'log')!r}))"
        child = subprocess.run(
            [sys.executable, "-c", code], env={**os.environ, **shim.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            check=False, capture_output=True, text=True, timeout=60.0,
        )  # fmt: skip
        assert child.returncode == DIES, child.stderr
    return list(read_journal(shim.journal))
