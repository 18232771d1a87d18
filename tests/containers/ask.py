"""Run in a container beside the service: ask for all tiles, as a planner does, and print what they are as JSON."""

import json
import sys

import xxhash

from roughmap_client import RoughMapClient

with RoughMapClient("site", connect=[sys.argv[1]], timeout=10) as client:
    tiles = sorted(client.tiles(), key=lambda tile: tile.key[1:])
    digest = xxhash.xxh3_128()
    for tile in tiles:  # the digest of a map, from those of its tiles
        for place in tile.key[1:]:
            digest.update(place.to_bytes(4, "little", signed=True))
        digest.update(bytes.fromhex(tile.info.digest))
    status = client.status()
print(
    json.dumps(
        {
            "digest": digest.hexdigest(),
            "tiles": len(tiles),
            "known_cells": sum(tile.info.known_cells for tile in tiles),
            "sequence": status.sequence,
            "epoch": status.epoch,
            "health": status.health,
            "log_ok": status.log.ok,
            "refused": status.refused,
            "gaps": status.gaps,
        }
    )
)
