"""The Python client: query a roughmap service for its map, and feed it, over Zenoh.

client.py                   `RoughMapClient`; start here
session.py, access.py       the Zenoh session and one query; certificates and passwords
replies.py, contract.py     from replies to arrays; checks of the contract's version
results.py, errors.py       what the client returns and raises
watching.py                 calls back with tiles as they change
"""

from roughmap_client.client import RoughMapClient
from roughmap_client.errors import (
    BadArgument,
    ContractMismatch,
    IncompleteAnswer,
    MixedInstances,
    NoAnswer,
    QueryRefused,
    RoughMapError,
    UnreadableAnswer,
)
from roughmap_client.results import Cells, Changes, Layers, Region, Tile, Version
from roughmap_client.watching import Watch

__all__ = [
    "BadArgument",
    "Cells",
    "Changes",
    "ContractMismatch",
    "IncompleteAnswer",
    "Layers",
    "MixedInstances",
    "NoAnswer",
    "QueryRefused",
    "Region",
    "RoughMapClient",
    "RoughMapError",
    "Tile",
    "UnreadableAnswer",
    "Version",
    "Watch",
]
