"""What `make faults` tries, and how often in full."""

import random
from collections.abc import Callable
from pathlib import Path

from bad_links import lost_messages, torn_links
from bytes_lost import log_cuts, log_flips, store_flips
from clock_jumps import clock_jumps
from full_disk import full_disks, hung_disks, real_disk
from kill_and_cut import kills_and_cuts
from kills import kills, kills_in_shutdown, kills_in_start
from odd_stores import odd_stores
from power_cuts import power_cuts
from report import Trial

Try = Callable[[Trial, Path, random.Random, int], None]


def every_byte(trial: Trial, folder: Path, rng: random.Random, number: int) -> None:
    """`log_cuts` at a share of all bytes: at 1 and above at every one."""
    log_cuts(trial, folder, rng, None if number >= EVERY else number)


EVERY = 70_000

TRIALS: dict[str, tuple[str, Try, int]] = {
    "kills": ("SIGKILL under load", kills, 50),
    "start": ("SIGKILL in start-up", kills_in_start, 10),
    "shutdown": ("SIGKILL in shutdown", kills_in_shutdown, 10),
    "power": ("power cut", power_cuts, 200),
    "killcut": ("SIGKILL, a start, then power cuts", kills_and_cuts, 30),
    "cuts": ("log cut at a byte of its last 64 KiB", every_byte, EVERY),
    "logflips": ("one bit flipped in the log", log_flips, 500),
    "storeflips": ("one bit flipped in the store", store_flips, 500),
    "stores": ("store gone, old, or newer than the log", odd_stores, 200),
    "disk": ("disk full, broken, read-only (injected)", full_disks, 12),
    "hang": ("disk hangs (injected)", hung_disks, 6),
    "realdisk": ("file system full, then read-only (real)", real_disk, 2),
    "clock": ("wall clock jumps an hour", clock_jumps, 10),
    "links": ("link cut and held up under ingest", torn_links, 20),
    "messages": ("requests and receipts lost and doubled", lost_messages, 200),
}
"""Name -> what it is, what does it, how often in full."""
