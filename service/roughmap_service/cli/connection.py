"""A session with a running service, for the commands that ask or feed one."""

import json
import re
import time
from collections.abc import Sequence
from pathlib import Path

import zenoh

from roughmap_client.access import endpoints_of, read_zenoh_file, setting, zenoh_message
from roughmap_schemas.config import without_secrets
from roughmap_schemas.config_load import LoadedConfig
from roughmap_service.cli.options import Failure, reachable
from roughmap_service.host.exposure import is_encrypted
from roughmap_service.inputs.session import zenoh_config

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
"""Where `serve` listens unless told otherwise, so that the commands find it without an option."""

TRY_S = 2.0
"""How long one try to connect may take: a signal is heeded between two."""


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
    until = time.monotonic() + timeout
    while True:
        left = max(until - time.monotonic(), 0.1)
        config.insert_json5("connect/timeout_ms", str(int(min(left, TRY_S) * 1000)))
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            if left > TRY_S:
                continue
            where = ", ".join(map(without_secrets, endpoints_of(config, "connect")))
            raise Failure(
                f"nobody answers on {where} ({zenoh_message(error, config)}); is `roughmap serve` up there? "
                f"(--connect, --zenoh){if_guarded(config)}"
            ) from None


def if_guarded(config: zenoh.Config) -> str:
    """What else may be behind silence where access is guarded, to put after a question; nothing where it is not."""
    user = setting(config, "transport/auth/usrpwd/user")
    certificate = setting(config, "transport/link/tls/connect_certificate")
    if certificate or user:
        shown = certificate or f"the user {user!r}"
        return f" Or does it not let {shown} in, or not do this? Denials are silent (SECURITY.md)"
    if wants_certificate(config):
        return " Or does it want a certificate? None is set to connect with: --zenoh docker/access/planner.json5"
    return ""


def wants_certificate(config: zenoh.Config) -> bool:
    """It connects by TLS and has nothing to show: so do the settings of a router, which has a certificate to listen."""
    shown = any(setting(config, f"transport/{path}") for path in ("link/tls/connect_certificate", "auth/usrpwd/user"))
    return not shown and any(map(is_encrypted, endpoints_of(config, "connect")))
