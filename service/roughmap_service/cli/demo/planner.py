"""The demo's planner: a client that queries the ground around the rover."""

import threading
import time
from types import TracebackType
from typing import Self

import numpy as np

from roughmap_client import RoughMapClient
from roughmap_client.errors import RoughMapError
from roughmap_service.simulation.rover import Rover

QUERY_HZ = 5.0
QUERY_SIDE_M = 20.0
QUERY_LAYERS = ["mean_height", "slope", "step_height", "traversability"]


class Planner:
    """Queries the ground around the rover while it drives, in a thread; a context manager."""

    def __init__(self, client: RoughMapClient, rover: Rover) -> None:
        self.latencies: list[float] = []
        self.errors: list[str] = []
        self.worst_lag: tuple[float, float] | None = None
        """The service's worst lag, arrival to queryable, as p50 and p99 in s; None before the first."""
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
                    continue  # the map is still empty: such an answer would make the figures look better
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
