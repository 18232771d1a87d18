"""The Zenoh session of the service: opened from the configuration, and where it can be reached."""

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
from roughmap_service.host.exposure import exposures, weaknesses

log = logging.getLogger(__name__)

ADMIN_SECONDS = 5.0
"""How long the session's own admin space may take to answer: it is asked in this process."""


LEAST_BOUND = 4 << 20
"""Bytes that a message may always have: a question may come with 1 MiB of places."""


class TransportError(Exception):
    """The session can't be opened; one line that names what to change."""


def zenoh_config(loaded: LoadedConfig) -> zenoh.Config:
    """The session's configuration: a zenoh file, if one is named, under the settings that were given.

    A setting given nowhere leaves the file's value alone. The admin space is on, read only: only there does a session
    tell the port that it got for 0. ConfigFault for a file that can't be used.
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
    if settings.mode == "peer":  # a router needs gossip to know which peers don't reach each other
        entries.append(("scouting", "scouting/gossip/enabled", settings.scouting))
    for name, path, value in entries:
        if not settings.config_file or loaded.given(f"zenoh.{name}"):
            config.insert_json5(path, json.dumps(value))
    add_access(config, settings)
    config.insert_json5("adminspace/enabled", "true")
    config.insert_json5("adminspace/permissions", json.dumps({"read": True, "write": False}))
    return config


def bound_messages(config: zenoh.Config, largest: int) -> None:
    """Have Zenoh drop messages of more than twice ``largest`` bytes: it puts each together in memory, up to 1 GiB by
    itself, before anybody here can refuse it. Up to that they are refused by name, and counted."""
    path = "transport/link/rx/max_message_size"
    config.insert_json5(path, str(min(setting(config, path), max(2 * largest, LEAST_BOUND))))


def check_exposure(config: zenoh.Config, loaded: LoadedConfig, *, insecure: bool) -> None:
    """Raise ConfigFault for a session that whoever is on the network can join; ``insecure`` only has it warned of."""
    found = exposures(config)
    if found and not insecure:
        path, _, text = found[0].partition(":")
        name, file = f"zenoh.{path.partition('.')[0]}", loaded.config.zenoh.config_file
        where = f"zenoh.config_file {file}: {path}" if file and not loaded.given(name) else name
        raise ConfigFault(
            f"{where}:{text}; use tls/ with certificates (SECURITY.md), stay on tcp/127.0.0.1 with zenoh.scouting = "
            "false, or allow it by --insecure"
        )
    for text in (*found, *weaknesses(config)):
        log.warning("insecure: %s", text)


def open_session(config: zenoh.Config) -> zenoh.Session:
    """Open the session; TransportError where a port is taken or a setting is wrong."""
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        text = zenoh_message(error, config)
        if text.startswith("Unable to connect"):
            mend = "is the router up there, and does it trust the certificate, or know user and password?"
        else:
            mend = "is the port in use? Set zenoh.listen to another one"
        where = ", ".join(
            without_secrets(one) for which in ("listen", "connect") for one in endpoints_of(config, which)
        )
        raise TransportError(f"zenoh can't be opened on {where or 'no endpoint'} ({text}); {mend}") from None


def endpoints(session: zenoh.Session) -> list[str]:
    """Where the session listens, with real ports."""
    zid = str(session.info.zid())
    for reply in session.get(f"@/{quote(zid)}/*", timeout=ADMIN_SECONDS):
        if reply.ok is not None:
            return [str(locator) for locator in json.loads(reply.ok.payload.to_bytes()).get("locators", [])]
    return []


def claim(
    session: zenoh.Session, keys: Keys, instance: str, seconds: float, stop: threading.Event
) -> tuple[zenoh.LivelinessToken, list[str]]:
    """Declare this instance's token, then wait until no other instance of the map has one.

    Returns the token, and the others still there after ``seconds`` or at ``stop``. Whoever looks has declared before:
    of two that start at once not both can see nobody. That not both give way either, the one whose name is behind
    another's withdraws its token until that one is gone.
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
            log.warning(
                "this map seems to be served already: %s; waiting at most %g s for it to go (a killed service is seen "
                "until its lease ends; service.alive_wait); if it still runs, stop it, or set another map.name here",
                ", ".join(others), seconds,
            )  # fmt: skip
            warned = True
        if others[0] < own:
            token.undeclare()
        # Their tokens end by themselves: the lease of a dead instance, or the shutdown of a living one.
        stop.wait(min(0.2, left))
        if others[0] < own:
            token = session.liveliness().declare_token(own)
