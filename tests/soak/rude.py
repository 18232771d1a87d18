"""A client that takes no care of others, in a process of its own: `rude.py listen|ask|poses ENDPOINT`.

`listen` subscribes to all that the service sends, `ask` asks for the whole map, 200 requests at once, again and again,
and `poses` publishes poses of robot `loud` as fast as it can. Each tells by a line when it begins, and goes on until
its standard input closes; the last two then tell how often.
"""

import sys
import threading

import soak_paths  # noqa: F401 - before what it makes importable
import zenoh
from net import WAIT_S, peer_config
from processes import LEVEL, PRECISE, T0

from roughmap_schemas import encode_odometry

AT_ONCE = 200
"""Three times what may wait (`query.queue_limit`)."""


def main(what: str, endpoint: str) -> None:
    """Be rude."""
    told = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), told.set()), daemon=True).start()
    with zenoh.open(peer_config(connect=[endpoint])) as session:
        if what == "listen":
            session.declare_subscriber("maps/site/**", lambda sample: sample.payload.to_bytes())
            heard = threading.Event()
            session.get("maps/site/status", zenoh.handlers.Callback(lambda _: None, heard.set), timeout=WAIT_S)
            heard.wait(WAIT_S)
            print("listening", flush=True)
            told.wait()
        elif what == "ask":
            print("asking", flush=True)
            print(_ask(session, told), flush=True)
        else:
            print("publishing", flush=True)
            number = 0
            while not told.is_set():
                payload = encode_odometry(T0 + number * 10**5, "map", (0, 0, 0), LEVEL, PRECISE)
                session.put("robots/loud/odometry", payload, congestion_control=zenoh.CongestionControl.BLOCK)
                number += 1
            print(number, flush=True)


def _ask(session: zenoh.Session, told: threading.Event) -> int:
    places, asked = threading.Semaphore(AT_ONCE), 0
    while not told.is_set():
        if not places.acquire(timeout=1.0):
            continue
        session.get(
            "maps/site/tiles/0/*/*?layers=mean_height,slope,range", zenoh.handlers.Callback(_forget, places.release),
            timeout=WAIT_S, consolidation=zenoh.ConsolidationMode.NONE,
        )  # fmt: skip
        asked += 1
    return asked


def _forget(_: zenoh.Reply) -> None:
    """It doesn't even look."""


if __name__ == "__main__":
    main(*sys.argv[1:])
