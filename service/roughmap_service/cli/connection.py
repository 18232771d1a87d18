"""A session with a running service, for the commands that ask or feed one."""

import json
import re
from collections.abc import Sequence
from pathlib import Path

import zenoh

from roughmap_client.access import endpoints_of, read_zenoh_file, told
from roughmap_schemas.config import without_secrets
from roughmap_schemas.config_load import LoadedConfig
from roughmap_service.cli.options import Failure, reachable
from roughmap_service.transport import zenoh_config

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
"""Where `serve` listens unless told otherwise, so that the commands find it without an option."""


def client_config(loaded: LoadedConfig, connect: Sequence[str], file: Path | None = None) -> zenoh.Config:
    """A client by a zenoh file, or else with the certificates, user and password of the service's own settings.

    It connects to ``connect``; else to where the file says, or where the configured service listens, if its ports are
    known, or to the router it joins. ConfigFault for a file that can't be used.
    """
    config = read_zenoh_file(file, "--zenoh") if file is not None else zenoh_config(loaded)
    known = [reachable(one) for one in endpoints_of(config, "listen") if not re.search(r":0([?#]|$)", one)]
    joined = endpoints_of(config, "connect")
    endpoints = list(connect) or (joined if file is not None else known or joined) or [DEFAULT_ENDPOINT]
    settings = {
        "mode": "client",
        "listen/endpoints": [],
        "scouting/multicast/enabled": False,
        "connect/endpoints": endpoints,
    }
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return config


def open_client(config: zenoh.Config, timeout: float) -> zenoh.Session:
    """The session. Failure, in one line, if the service isn't there within ``timeout`` seconds."""
    config.insert_json5("connect/timeout_ms", str(int(timeout * 1000)))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = ", ".join(map(without_secrets, endpoints_of(config, "connect")))
        raise Failure(
            f"nobody answers on {where} ({told(error, config)}); is `roughmap serve` up there? (--connect, --zenoh)"
        ) from None
