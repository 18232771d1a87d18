"""Who could reach the service, and with what."""

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
"""Bytes of a token that nobody guesses."""


def zenoh_access(loaded: LoadedConfig) -> list[Finding]:
    """What of the Zenoh session is open to the network, and the certificates that guard it."""
    try:
        config = zenoh_config(loaded)
    except ConfigFault as error:
        return [Finding("security", "wrong", str(error), "mend the file or the setting that is named")]
    mend = "use tls/ endpoints with certificates, stay on tcp/127.0.0.1, or --insecure if the network is guarded"
    findings = [Finding("security", "wrong", f"zenoh.{text}", mend) for text in exposures(config)]
    kept = "use tls/ with certificates (SECURITY.md), or keep the network closed"
    findings += [Finding("security", "note", text, kept) for text in weaknesses(config)]
    if not findings:
        findings = [Finding("security", "ok", "the Zenoh session lets in nobody beyond this machine without TLS")]
    return findings + certificates(config, datetime.now(UTC))


def http_access(http: HttpConfig) -> Finding | None:
    """The token of the pages; None where there is nothing to say."""
    if http.listen is None:
        return None
    try:
        token = token_of(http)
    except HttpError as error:
        return Finding("security", "wrong", str(error), "write a token into the file, readable by the service alone")
    if token is None:
        if is_loopback(http.listen.rpartition(":")[0]):
            return None
        mend = "give one in http.token_file or ROUGHMAP_HTTP__TOKEN, listen on 127.0.0.1, or --insecure if guarded"
        return Finding("security", "wrong", f"http.listen: {http.listen} is open to the network, without a token", mend)
    if len(token) < LEAST_TOKEN:
        return Finding("security", "note", f"the http token has {len(token)} bytes", "openssl rand -hex 16 makes one")
    if http.token_file is not None and Path(http.token_file).stat().st_mode & 0o077:
        told = f"http.token_file: {http.token_file} can be read by others"
        return Finding("security", "note", told, f"chmod 600 {http.token_file}")
    if not is_loopback(http.listen.rpartition(":")[0]):
        told = "the pages want a token; it goes over the network unencrypted"
        return Finding("security", "note", told, "have a proxy with TLS before http.listen, or keep the network closed")
    return Finding("security", "ok", "the pages want a token")
