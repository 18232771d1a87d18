"""A session with a running service, for the commands that look at it."""

import json

import zenoh

from roughmap_client.access import add_access, read_zenoh_file, told
from roughmap_schemas.sections import ZenohConfig
from roughmap_service.cli.options import Failure


def open_client(given: ZenohConfig, endpoints: list[str], timeout: float) -> zenoh.Session:
    """A client of the service at one of these endpoints, with the certificates, user and password of the ``zenoh``
    settings. Failure, in one line, if it isn't there within ``timeout`` seconds."""
    config = read_zenoh_file(given.config_file) if given.config_file else zenoh.Config()
    add_access(config, given)
    settings = {
        "mode": "client",
        "listen/endpoints": [],
        "scouting/multicast/enabled": False,
        "connect/endpoints": endpoints,
        "connect/timeout_ms": int(timeout * 1000),
    }
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = ", ".join(endpoint.partition("#")[0] for endpoint in endpoints)
        raise Failure(
            f"nobody answers on {where} ({told(error, config)}); is `roughmap serve` up there? (--connect)"
        ) from None
