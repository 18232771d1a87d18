"""Checks of access: who could reach the service, and with which credentials."""

from datetime import UTC, datetime
from pathlib import Path

from roughmap_schemas.config_load import LoadedConfig
from roughmap_schemas.faults import ConfigFault
from roughmap_schemas.sections import HttpConfig
from roughmap_service.cli.doctor.certificates import certificates
from roughmap_service.cli.doctor.findings import Finding
from roughmap_service.host.exposure import exposures, is_loopback, weaknesses
from roughmap_service.http.token import HttpError, token_of
from roughmap_service.inputs.session import zenoh_config

LEAST_TOKEN = 16
"""Shortest token, in bytes, that is hard to guess."""


def zenoh_access(loaded: LoadedConfig) -> list[Finding]:
    """Check what the Zenoh session opens to the network, and its certificates."""
    try:
        config = zenoh_config(loaded)
    except ConfigFault as error:
        return [Finding("security", "wrong", str(error), "correct this file or setting")]
    remedy = "use tls/ endpoints with certificates, or only 127.0.0.1, or start with --insecure on a closed network"
    findings = [Finding("security", "wrong", f"zenoh.{text}", remedy) for text in exposures(config)]
    kept = "use tls/ endpoints with certificates (SECURITY.md), or keep the network closed"
    findings += [Finding("security", "note", text, kept) for text in weaknesses(config)]
    if not findings:
        findings = [Finding("security", "ok", "the Zenoh session is closed to the network, or uses TLS")]
    return findings + certificates(config, datetime.now(UTC))


def http_access(http: HttpConfig) -> Finding | None:
    """Check the token of the HTTP pages; None if they are off or only on loopback."""
    if http.listen is None:
        return None
    try:
        token = token_of(http)
    except HttpError as error:
        return Finding("security", "wrong", str(error), "write a token into the file, readable by the service only")
    if token is None:
        if is_loopback(http.listen.rpartition(":")[0]):
            return None
        remedy = "set http.token_file, or listen on 127.0.0.1, or start with --insecure on a closed network"
        return Finding(
            "security", "wrong", f"http.listen: {http.listen} is open to the network without a token", remedy
        )
    if len(token) < LEAST_TOKEN:
        return Finding(
            "security",
            "note",
            f"the http token is only {len(token)} bytes long",
            "create one with `openssl rand -hex 16`",
        )
    if http.token_file is not None and Path(http.token_file).stat().st_mode & 0o077:
        text = f"http.token_file: {http.token_file} is readable by others"
        return Finding("security", "note", text, f"chmod 600 {http.token_file}")
    if not is_loopback(http.listen.rpartition(":")[0]):
        text = "the HTTP pages require a token, which is sent unencrypted"
        return Finding("security", "note", text, "put a proxy with TLS before http.listen, or keep the network closed")
    return Finding("security", "ok", "the HTTP pages require a token")
