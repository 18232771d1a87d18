"""A region of 400 tiles beside a bare echo of the same bytes, over both kinds of link."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import product
from pathlib import Path

import zenoh
from asker import timed_get
from asking import echoing
from figures import Bench
from scans import SCANS, recorded
from serving import MAP, fill, open_session, served

TWO_LAYERS = "layers=mean_height,range"
SITES = [(x, y) for x, y in product((-52.0, -26.0, 0.0, 26.0, 52.0), repeat=2)]
"""Beyond 20 m rings lie far apart: from these every tile of the 400 is seen."""

KINDS = {
    "region": (f"maps/{MAP}/region?bbox=-64,-64,64,64;{TWO_LAYERS}", 1),
    "tiles": (f"maps/{MAP}/tiles/0/*/*?bbox=-64,-64,64,64;{TWO_LAYERS}", 400),
}
"""What is asked, and in how many replies it comes."""

LINKS = {"shm": "shared memory", "tcp": "TCP"}

Rates = dict[tuple[str, str], tuple[list[float], list[float]]]


@contextmanager
def filled_service(bench: Bench, folder: Path) -> Iterator[tuple[list[str], list[str], zenoh.Session]]:
    """A service whose map covers the 400 tiles: its endpoints, an echo's, and a session with the service."""
    with served(folder) as service, open_session(service.endpoints) as session, echoing() as echo:
        fill(bench, session, recorded(bench.folder, 3 if bench.quick else SCANS), SITES)
        yield service.endpoints, echo, session


def rates(bench: Bench, service: list[str], echo: list[str], rounds: int, kinds: Sequence[str] = tuple(KINDS)) -> Rates:
    """MB/s of the service and of the echo by kind and link, a value a round, after a round that warms up.

    By shared memory one grid of 13 MB travels fast only where Zenoh's pool of 16 MiB has room for it in one piece.
    """
    taken: Rates = {k: ([], []) for k in product(kinds, LINKS)}
    with ExitStack() as stack:
        sessions = {
            link: [stack.enter_context(open_session(to, shared_memory=link == "shm")) for to in (service, echo)]
            for link in LINKS
        }
        for turn in range(bench.rounds(rounds) + 1):
            bench.say(f"queries: 400 tiles, round {turn} of {bench.rounds(rounds)}")
            for kind, link in taken:
                asked, echoed = sessions[link]
                selector, expected = KINDS[kind]
                seconds, size, replies = timed_get(asked, selector)
                if replies != expected:
                    raise RuntimeError(f"{selector}: {replies} replies, not {expected}")
                beside, back, _ = timed_get(echoed, f"echo?size={size // replies};replies={replies}")
                if turn:
                    taken[kind, link][0].append(size / seconds / 1e6)
                    taken[kind, link][1].append(back / beside / 1e6)
    return taken
