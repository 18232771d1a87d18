"""A Zenoh session with a running service, for the commands that query or feed it."""

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
"""Where `serve` listens by default, so that the commands find it without an option."""

TRY_S = 2.0
"""Seconds of one attempt to connect; a signal is handled between two attempts."""


def client_config(loaded: LoadedConfig, connect: Sequence[str], file: Path | None = None) -> zenoh.Config:
    """Return a client's Zenoh configuration: from ``file``, or with the certificates, user and password of [zenoh].

    The endpoint is the first that is given of: ``connect``; the file's; where the configured service listens, unless
    its port is 0; the router that the service connects to; `DEFAULT_ENDPOINT`. ConfigFault for a bad file.
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
    """Open a session; Failure if nothing answers within ``timeout`` seconds."""
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
    """Return a hint at access control to append to a question; "" where the session shows and needs no identity."""
    user = setting(config, "transport/auth/usrpwd/user")
    certificate = setting(config, "transport/link/tls/connect_certificate")
    if certificate or user:
        shown = certificate or f"the user {user!r}"
        return f" Or is {shown} not allowed to do this? Zenoh denies silently (SECURITY.md)"
    if lacks_certificate(config):
        return (
            " Or does it require a certificate? None is configured; pass one, as in --zenoh docker/access/planner.json5"
        )
    return ""


def lacks_certificate(config: zenoh.Config) -> bool:
    """Tell whether the session connects by TLS without certificate or user.

    The settings of a router are such: its certificate is only for listening.
    """
    shown = any(setting(config, f"transport/{path}") for path in ("link/tls/connect_certificate", "auth/usrpwd/user"))
    return not shown and any(map(is_encrypted, endpoints_of(config, "connect")))
