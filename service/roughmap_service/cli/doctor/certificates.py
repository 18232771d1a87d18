"""Checks of certificates: that they can be read, match their keys and are valid now."""

import ssl
from datetime import UTC, datetime, timedelta
from pathlib import Path

import zenoh

from roughmap_client.access import setting
from roughmap_service.cli.doctor.findings import Finding

SOON = timedelta(days=30)
"""A certificate that expires within this time gets a note."""

PEM_END = "-----END CERTIFICATE-----"

CERTIFICATES = ("root_ca_certificate", "listen_certificate", "connect_certificate")
PAIRS = (("listen_certificate", "listen_private_key"), ("connect_certificate", "connect_private_key"))


def certificates(config: zenoh.Config, now: datetime) -> list[Finding]:
    """Check each certificate and key that the session's configuration names, once."""
    files = {name: setting(config, f"transport/link/tls/{name}") for name in {*CERTIFICATES, *sum(PAIRS, ())}}
    named = sorted({(files[name], name == CERTIFICATES[0]) for name in CERTIFICATES if files[name]})
    findings = [_file(Path(path), now, any_will_do=is_authority) for path, is_authority in named]
    for certificate, key in sorted({(files[one], files[two]) for one, two in PAIRS if files[one] and files[two]}):
        findings.append(_pair(certificate, key))
    return findings


def _file(path: Path, now: datetime, *, any_will_do: bool) -> Finding:
    """Check the dates in a PEM file: of a chain all must be valid, of several authorities (``any_will_do``) one."""
    try:
        blocks = [block + PEM_END for block in path.read_text(encoding="ascii").split(PEM_END)[:-1]]
        spans = [validity(ssl.PEM_cert_to_DER_cert(block[block.index("-----BEGIN") :])) for block in blocks]
    except (OSError, ValueError, IndexError) as error:
        return Finding("certificates", "wrong", f"{path}: can't read a certificate ({error})", "create it again")
    if not spans:
        return Finding("certificates", "wrong", f"{path}: no certificate in PEM form", "create it again")
    if any_will_do:
        begin, end = max(spans, key=lambda span: span[1])
    else:
        begin, end = max(span[0] for span in spans), min(span[1] for span in spans)
    if now < begin:
        remedy = "set this machine's clock, or wait"
        return Finding("certificates", "wrong", f"{path}: not valid before {begin:%Y-%m-%d %H:%M} UTC", remedy)
    if now >= end:
        return Finding("certificates", "wrong", f"{path}: expired {end:%Y-%m-%d %H:%M} UTC", "renew it")
    text = f"{path}: valid until {end:%Y-%m-%d}, {(end - now).days} days left"
    if end - now < SOON:
        return Finding("certificates", "note", text, "renew it in time; Zenoh closes the links when it expires")
    return Finding("certificates", "ok", text)


def _pair(certificate: str, key: str) -> Finding:
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password=lambda: b"")
    except (OSError, ValueError) as error:
        cause = getattr(error, "reason", None) or getattr(error, "strerror", None) or error
        remedy = "use the key that the certificate was made for, unencrypted and readable"
        return Finding("certificates", "wrong", f"{key} is not the key of {certificate} ({cause})", remedy)
    if Path(key).stat().st_mode & 0o077:
        return Finding("certificates", "note", f"{key} is readable by others", f"chmod 600 {key}")
    return Finding("certificates", "ok", f"{key} is the key of {certificate}")


def validity(der: bytes) -> tuple[datetime, datetime]:
    """Return from when until when a certificate is valid (RFC 5280, 4.1). ValueError or IndexError for other bytes.

    Parsed here, because Python's ssl gives the dates only of a certificate that it trusts, which an expired one is not.
    """
    certificate = _inside(der, 0)
    at = _inside(der, certificate[0])[0]  # tbsCertificate's first member
    if der[at] == 0xA0:  # the version, if it is there
        at = _inside(der, at)[1]
    for _ in ("serialNumber", "signature", "issuer"):
        at = _inside(der, at)[1]
    first = _inside(der, at)[0]
    return _time(der, first), _time(der, _inside(der, first)[1])


def _inside(der: bytes, at: int) -> tuple[int, int]:
    """Return where the content of the DER value at ``at`` begins and ends."""
    length, begin = der[at + 1], at + 2
    if length & 0x80:
        size = length & 0x7F
        length, begin = int.from_bytes(der[begin : begin + size], "big"), begin + size
    if begin + length > len(der):
        raise ValueError("truncated")
    return begin, begin + length


def _time(der: bytes, at: int) -> datetime:
    """Parse a UTCTime (two digits of the year, 1950 to 2049) or a GeneralizedTime."""
    begin, end = _inside(der, at)
    text = der[begin:end].decode("ascii")
    if der[at] == 0x17:
        text = ("19" if text[:2] >= "50" else "20") + text
    return datetime.strptime(text, "%Y%m%d%H%M%SZ").replace(tzinfo=UTC)
