"""Certificates and passwords in a Zenoh configuration, and Zenoh's error messages without secrets."""

import contextlib
import json
import re
from pathlib import Path
from typing import Any, Final

import zenoh

from roughmap_schemas.config import HIDDEN, without_secrets
from roughmap_schemas.faults import ConfigFault
from roughmap_schemas.sections import ZenohConfig

MAX_PASSWORD: Final = 4096
"""Bytes of a password file: anything larger is some other file."""


def read_zenoh_file(path: str | Path, name: str = "zenoh.config_file") -> zenoh.Config:
    """Read a Zenoh configuration (JSON5); raises ConfigFault, which names the place of an error but not its text."""
    _check_readable(name, path)
    try:
        return zenoh.Config.from_file(str(path))
    except zenoh.ZError as error:
        raise ConfigFault(f"{name}: {path}: not a Zenoh configuration{_place(str(error))}") from None


def add_access(config: zenoh.Config, given: ZenohConfig) -> None:
    """Put the certificates, user and password of the ``zenoh`` settings into a configuration; keep what isn't given.

    Raises ConfigFault for an unreadable file.
    """
    tls: dict[str, object] = {}
    if given.authority:
        _check_readable("zenoh.authority", given.authority)
        tls["root_ca_certificate"] = given.authority
    if given.certificate and given.private_key:
        _check_readable("zenoh.certificate", given.certificate)
        _check_readable("zenoh.private_key", given.private_key)
        for side in ("listen", "connect"):
            tls[f"{side}_certificate"] = given.certificate
            tls[f"{side}_private_key"] = given.private_key
        if given.authority:
            tls["enable_mtls"] = True
    if tls:
        tls["close_link_on_expiration"] = True
    for name, value in tls.items():
        config.insert_json5(f"transport/link/tls/{name}", json.dumps(value))
    if given.user:
        config.insert_json5("transport/auth/usrpwd/user", json.dumps(given.user))
        config.insert_json5("transport/auth/usrpwd/password", json.dumps(_password(given)))


def endpoints_of(config: zenoh.Config, which: str) -> list[str]:
    """Return the endpoints on which a session will ``listen``, or to which it will ``connect``, in its mode."""
    value = _of_mode(setting(config, f"{which}/endpoints"), setting(config, "mode") or "peer")
    # Several endpoints of one neighbour may be in a table with its strategy.
    groups = [one["locators"] if isinstance(one, dict) else [one] for one in value or []]
    return [endpoint for group in groups for endpoint in group]


def setting(config: zenoh.Config, path: str) -> Any:
    """Return a value of a Zenoh configuration, None if it is left to Zenoh."""
    return json.loads(config.get_json(path))


def zenoh_message(error: Exception, config: zenoh.Config) -> str:
    """Return Zenoh's message of an error in one line, without secrets and without the place in Zenoh's sources."""
    text = str(error).split("\n", 1)[0].split(" at /", 1)[0]
    for endpoint in endpoints_of(config, "listen") + endpoints_of(config, "connect"):
        text = text.replace(endpoint, without_secrets(endpoint))
    # And anything else that looks like the end of an endpoint: Zenoh may format it differently.
    return re.sub(rf"(/[^\s?#\]),]+)[?#](?!{HIDDEN})[^\s\]),]*", rf"\1#{HIDDEN}", text)[:200]


def _password(given: ZenohConfig) -> str:
    if given.password is not None:
        return given.password.get_secret_value()
    path = Path(given.password_file or "")
    _check_readable("zenoh.password_file", path)
    with path.open("rb") as stream:
        content = stream.read(MAX_PASSWORD + 1)
    with contextlib.suppress(UnicodeDecodeError):
        password = content.decode().rstrip("\r\n")
        if password and len(content) <= MAX_PASSWORD:
            return password
    raise ConfigFault(f"zenoh.password_file: {path}: expected a password as UTF-8 text, at most {MAX_PASSWORD} bytes")


def _check_readable(name: str, path: str | Path) -> None:
    try:
        with Path(path).open("rb"):
            pass
    except OSError as error:
        raise ConfigFault(f"{name}: {path}: can't be read: {error.strerror or error}") from None


def _place(error: str) -> str:
    """Return line, column and what was expected there, but not what was found: it may be a password."""
    at = re.search(r"line: (\d+), column: (\d+)", error) or re.search(r"--> (\d+):(\d+)", error)
    expected = re.search(r"expected ([^\"\n]+?)(?:\"| at /|$)", error, re.MULTILINE)
    return (f", line {at[1]}, column {at[2]}" if at else "") + (f": expected {expected[1]}" if expected else "")


def _of_mode(value: Any, mode: str) -> Any:
    return value.get(mode) if isinstance(value, dict) else value
