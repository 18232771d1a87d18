"""The service's Zenoh session: opens it from the configuration, limits messages, and claims the map's name."""

import json
import logging
import threading
import time
from urllib.parse import quote

import zenoh

from roughmap_client.access import add_access, endpoints_of, read_zenoh_file, setting, zenoh_message
from roughmap_schemas import ConfigFault, Keys
from roughmap_schemas.config import without_secrets
from roughmap_schemas.config_load import LoadedConfig
from roughmap_schemas.faults import ReportedError
from roughmap_service.host.exposure import exposures, weaknesses

logger = logging.getLogger(__name__)

ADMIN_SECONDS = 5.0
"""Longest wait for the session's own admin space, which is in this process."""

LEAST_BOUND = 4 << 20
"""Message size in bytes that is always allowed: a query for cells may carry 1 MiB of places."""


class TransportError(ReportedError):
    """The session can't be opened; the text names what to change."""


def zenoh_config(loaded: LoadedConfig) -> zenoh.Config:
    """Return the session's configuration: the Zenoh file, if there is one, overridden by settings.

    A setting that is not given keeps the file's value. The admin space is on, read only, because only there can
    a session learn which port it got for port 0. ConfigFault if the file can't be used.
    """
    settings = loaded.config.zenoh
    config = read_zenoh_file(settings.config_file) if settings.config_file else zenoh.Config()
    entries = [
        ("mode", "mode", settings.mode),
        ("listen", "listen/endpoints", list(settings.listen)),
        ("connect", "connect/endpoints", list(settings.connect)),
        ("scouting", "scouting/multicast/enabled", settings.scouting),
        ("shared_memory", "transport/shared_memory/enabled", settings.shared_memory),
    ]
    if settings.mode == "peer":  # a router uses gossip to find peers that can't reach each other
        entries.append(("scouting", "scouting/gossip/enabled", settings.scouting))
    for name, path, value in entries:
        if not settings.config_file or loaded.given(f"zenoh.{name}"):
            config.insert_json5(path, json.dumps(value))
    add_access(config, settings)
    config.insert_json5("adminspace/enabled", "true")
    config.insert_json5("adminspace/permissions", json.dumps({"read": True, "write": False}))
    return config


def bound_messages(config: zenoh.Config, largest: int) -> None:
    """Let Zenoh drop messages of more than twice ``largest`` bytes.

    Zenoh assembles each message in memory, up to 1 GiB by default, before the service can refuse it. Smaller ones reach
    the service, which refuses and counts them by reason.
    """
    path = "transport/link/rx/max_message_size"
    config.insert_json5(path, str(min(setting(config, path), max(2 * largest, LEAST_BOUND))))


def check_exposure(config: zenoh.Config, loaded: LoadedConfig, *, insecure: bool) -> None:
    """Raise ConfigFault for a session that anyone on the network can join; with ``insecure`` only warn."""
    found = exposures(config)
    if found and not insecure:
        path, _, text = found[0].partition(":")
        name, file = f"zenoh.{path.partition('.')[0]}", loaded.config.zenoh.config_file
        where = f"zenoh.config_file {file}: {path}" if file and not loaded.given(name) else name
        raise ConfigFault(
            f"{where}:{text}; use tls/ with certificates (SECURITY.md), stay on tcp/127.0.0.1 with zenoh.scouting = "
            "false, or start with --insecure"
        )
    for text in (*found, *weaknesses(config)):
        logger.warning("insecure: %s", text)


def open_session(config: zenoh.Config) -> zenoh.Session:
    """Open the session; TransportError if a port is taken or a setting is wrong."""
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        text = zenoh_message(error, config)
        if text.startswith("Unable to connect"):
            remedy = "is the router running, and does it accept the certificate or the user and password?"
        else:
            remedy = "is the port in use? Set zenoh.listen to another"
        where = ", ".join(
            without_secrets(one) for which in ("listen", "connect") for one in endpoints_of(config, which)
        )
        raise TransportError(f"can't open zenoh on {where or 'no endpoint'} ({text}); {remedy}") from None


def endpoints(session: zenoh.Session) -> list[str]:
    """Return the endpoints on which the session listens, with real ports."""
    zid = str(session.info.zid())
    for reply in session.get(f"@/{quote(zid)}/*", timeout=ADMIN_SECONDS):
        if reply.ok is not None:
            return [str(locator) for locator in json.loads(reply.ok.payload.to_bytes()).get("locators", [])]
    return []


def claim(
    session: zenoh.Session, keys: Keys, instance: str, seconds: float, stop: threading.Event
) -> tuple[zenoh.LivelinessToken, list[str]]:
    """Declare this instance's token, then wait until no other instance of the map has one.

    Return the token, and the other instances that remain after ``seconds`` or at ``stop``. Each instance declares its
    token before it looks for others, so of two that start at once at least one sees the other. To keep both from giving
    way, the one whose name sorts later withdraws its token until the other is gone.
    """
    own, until = keys.alive(instance), time.monotonic() + seconds
    token = session.liveliness().declare_token(own)
    warned = False
    while True:
        others = sorted(
            key
            for reply in session.liveliness().get(keys.alive_any, timeout=min(2.0, seconds))
            if reply.ok is not None and (key := str(reply.ok.key_expr)) != own
        )
        left = until - time.monotonic()
        if not others or left <= 0 or stop.is_set():
            return token, others
        if not warned:
            logger.warning(
                "this map seems to be served already, by %s; waiting up to %g s (service.alive_wait) for it to end: "
                "the token of a killed service lives until its lease ends; if that service still runs, stop it or "
                "set another map.name here",
                ", ".join(others), seconds,
            )  # fmt: skip
            warned = True
        if others[0] < own:
            token.undeclare()
        # Tokens of others end with the lease of a dead instance or the shutdown of a running one.
        stop.wait(min(0.2, left))
        if others[0] < own:
            token = session.liveliness().declare_token(own)
