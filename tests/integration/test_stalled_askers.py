"""Clients that ask for much and stop reading: the service's end does not wait for them, nor call itself failed."""

import os
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from processes import STOP_S, T0, Service, connected, events_in

ASKER = """
import sys, zenoh
from net import WAIT_S, peer_config
with zenoh.open(peer_config(connect=[sys.argv[1]])) as session:
    list(session.get("maps/site/status", timeout=WAIT_S))
    for _ in range(40):
        session.get("maps/site/tiles/0/*/*?layers=mean_height,range,count", lambda _: None, timeout=WAIT_S,
                    consolidation=zenoh.ConsolidationMode.NONE)
    print("asked", flush=True)
    sys.stdin.read()
"""


def test_the_end_is_in_order_though_askers_stall(tmp_path: Path) -> None:
    settings = {"query": {"workers": 2}, "service": {"alive_wait": 0.2, "shutdown_timeout": 10 * STOP_S}}
    with ExitStack() as stack:
        service = stack.enter_context(Service(tmp_path, **settings))
        feed = stack.enter_context(connected(service))
        places = np.arange(30) * 6.4 + 0.05
        x, y = np.meshgrid(places, places)  # 900 tiles, a point each
        feed.decided(feed.cloud("r", T0, np.column_stack((x.ravel(), y.ravel(), np.zeros(x.size))), "map"))
        for _ in range(4):
            asker = subprocess.Popen(
                [sys.executable, "-c", ASKER, service.ready()["endpoints"][0]], stdin=subprocess.PIPE,
                stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
            )  # fmt: skip
            stack.callback(asker.communicate)
            stack.callback(asker.kill)
            assert asker.stdout is not None
            assert asker.stdout.readline() == b"asked\n"
            asker.send_signal(signal.SIGSTOP)
        assert service.stop() == 0, service.err[-1]  # within STOP_S: far from its limit
    kinds = [event.kind for event in events_in(service.log)]
    assert kinds == ["integration", "checkpoint"]
