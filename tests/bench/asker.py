"""Asks a service as a planner would, in a process of its own: `asker.py JSON`, latencies as JSON on standard output.

The JSON: service and echo (endpoints), hz, seconds, skip (the first so many seconds), and either "planner": true, or
"turns": [[where, selector], ...], where "service" or "echo", asked in turn. Out comes {"planner" or where: [seconds]}.
"""

import json
import sys
import threading
import time
from collections.abc import Callable
from itertools import cycle
from typing import Any

import numpy as np
import zenoh
from serving import MAP, open_session

from roughmap_client import RoughMapClient

TIMEOUT_S = 20.0
SIDE_M = 20.0


def timed_get(session: zenoh.Session, selector: str) -> tuple[float, int, int]:
    """Seconds until the last reply, bytes of all payloads, replies; RuntimeError for an error or none."""
    got: list[int] = []
    errors: list[bytes] = []
    ended = threading.Event()

    def take(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            got.append(len(reply.ok.payload.to_bytes()))
        elif reply.err is not None:
            errors.append(reply.err.payload.to_bytes())

    begun = time.perf_counter()
    session.get(
        selector, zenoh.handlers.Callback(take, ended.set), timeout=TIMEOUT_S,
        consolidation=zenoh.ConsolidationMode.NONE,
    )  # fmt: skip
    if not ended.wait(TIMEOUT_S + 1.0) or errors or not got:
        raise RuntimeError(f"{selector}: {errors[0][:200]!r}" if errors else f"{selector}: no answer")
    return time.perf_counter() - begun, sum(got), len(got)


def paced(
    hz: float, seconds: float, skip: float, asks: list[tuple[str, Callable[[], float]]]
) -> dict[str, list[float]]:
    """Latencies by name of ``asks``, which take turns at ``hz``; what is late is not made up for."""
    taken: dict[str, list[float]] = {name: [] for name, _ in asks}
    begun = time.perf_counter()
    turns = cycle(asks)
    while (now := time.perf_counter()) < begun + seconds:
        name, ask = next(turns)
        latency = ask()
        if now > begun + skip:
            taken[name].append(latency)
        time.sleep(max(now + 1.0 / hz - time.perf_counter(), 0.0))
    return taken


def main(given: dict[str, Any]) -> int:
    if given.get("planner"):
        rng = np.random.default_rng(1)
        with RoughMapClient(MAP, connect=given["service"]) as client:

            def plan() -> float:
                x, y = rng.uniform(-4.0, 4.0, 2)
                half = SIDE_M / 2
                begun = time.perf_counter()
                client.region((x - half, y - half, x + half, y + half), ["mean_height", "range"])
                return time.perf_counter() - begun

            taken = paced(given["hz"], given["seconds"], given["skip"], [("planner", plan)])
    else:
        sessions = {name: open_session(given[name]) for name in ("service", "echo")}
        asks = [
            (where, lambda where=where, selector=selector: timed_get(sessions[where], selector)[0])
            for where, selector in given["turns"]
        ]
        taken = paced(given["hz"], given["seconds"], given["skip"], asks)
        for session in sessions.values():
            session.close()
    print(json.dumps(taken))
    return 0


if __name__ == "__main__":
    sys.exit(main(json.loads(sys.argv[1])))
