"""A bare Zenoh queryable in a process of its own: `echo?size=BYTES;replies=N` gets so many bytes so many times.

Prints its endpoint when it is ready, and ends when its standard input does.
"""

import json
import random
import sys

import zenoh

ATTACHMENT = b"x" * 480
"""As long as a tile's."""

ENCODING = "application/protobuf;foxglove.Grid"


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
    payloads: dict[int, bytes] = {}
    with zenoh.open(config) as session:

        def answer(query: zenoh.Query) -> None:
            size, replies = int(query.parameters["size"]), int(query.parameters["replies"])
            payload = payloads.setdefault(size, random.randbytes(size))
            for _ in range(replies):
                query.reply("echo", payload, encoding=ENCODING, attachment=ATTACHMENT)
            query.drop()

        session.declare_queryable("echo", answer, complete=True)
        for reply in session.get(f"@/{session.zid()}/peer", timeout=10.0):
            if reply.ok is not None:
                print(json.dumps(json.loads(reply.ok.payload.to_bytes())["locators"]), flush=True)
        sys.stdin.read()
    return 0


if __name__ == "__main__":
    sys.exit(main())
