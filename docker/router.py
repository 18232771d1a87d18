"""Run a Zenoh router, where the official image is not available: python router.py router.json5."""

import signal
import sys
import threading

import zenoh

stop = threading.Event()
for number in (signal.SIGTERM, signal.SIGINT):
    signal.signal(number, lambda *_: stop.set())
with zenoh.open(zenoh.Config.from_file(sys.argv[1])):
    stop.wait()
