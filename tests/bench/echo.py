"""A bare Zenoh queryable in a process of its own: `echo?size=BYTES;replies=N` gets so many bytes so many times.

It answers from a thread of its own, as a service should: from Zenoh's callback 13 MB go out at a quarter of the rate.
Prints its endpoints when it is ready, and ends when its standard input does.
"""

import json
import sys
from threading import Thread

import zenoh

ATTACHMENT = b"x" * 480
"""As long as a tile's."""

ENCODING = "application/protobuf;foxglove.Grid"


def answer(queries: zenoh.Queryable) -> None:
    """One after the other, as they come."""
    payloads: dict[int, bytes] = {}
    for query in queries:
        size, replies = int(query.parameters["size"]), int(query.parameters["replies"])
        payload = payloads.setdefault(size, bytes(size))
        for _ in range(replies):
            query.reply("echo", payload, encoding=ENCODING, attachment=ATTACHMENT)
        query.drop()


def main() -> int:
    config = zenoh.Config()
    for path, value in {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "listen/endpoints": ["tcp/127.0.0.1:0"],
        "adminspace/enabled": True,
        "adminspace/permissions": {"read": True, "write": False},
    }.items():
        config.insert_json5(path, json.dumps(value))
    with zenoh.open(config) as session:
        queries = session.declare_queryable("echo", zenoh.handlers.FifoChannel(16), complete=True)
        Thread(target=answer, args=(queries,), daemon=True).start()
        for reply in session.get(f"@/{session.zid()}/peer", timeout=10.0):
            if reply.ok is not None:
                print(json.dumps(json.loads(reply.ok.payload.to_bytes())["locators"]), flush=True)
        sys.stdin.read()
    return 0


if __name__ == "__main__":
    sys.exit(main())
