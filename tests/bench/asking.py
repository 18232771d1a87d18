"""The askers and the echo, as processes beside the service."""

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

HERE = Path(__file__).parent
WAIT_S = 60.0

Latencies = dict[str, list[float]]


@contextmanager
def echoing() -> Iterator[list[str]]:
    """The echo; its endpoints."""
    arguments = [sys.executable, str(HERE / "echo.py")]
    with subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield json.loads(process.stdout.readline())
        finally:
            process.communicate(timeout=WAIT_S)


class Asker:
    """`asker.py` at work from now on, ``seconds`` long, of which the first ``skip`` are not counted; a context manager
    that ends it with the block."""

    def __init__(self, service: list[str], hz: float, seconds: float, skip: float, **more: Any) -> None:
        given = {"service": service, "hz": hz, "seconds": seconds, "skip": skip, **more}
        self._seconds = seconds
        self._process = subprocess.Popen(
            [sys.executable, str(HERE / "asker.py"), json.dumps(given)], stdout=subprocess.PIPE, text=True
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait(WAIT_S)
        assert self._process.stdout is not None
        self._process.stdout.close()

    def latencies(self) -> Latencies:
        """Once it has ended, seconds by what was asked."""
        text, _ = self._process.communicate(timeout=self._seconds + WAIT_S)
        if self._process.returncode != 0:
            raise RuntimeError("the asker failed")
        return dict(json.loads(text))
