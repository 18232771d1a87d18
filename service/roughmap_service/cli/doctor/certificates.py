"""Certificates: can they be read, do key and certificate match, are their dates right."""

import ssl
from datetime import UTC, datetime, timedelta
from pathlib import Path

import zenoh

from roughmap_client.access import setting
from roughmap_service.cli.doctor.findings import Finding

SOON = timedelta(days=30)
"""A certificate that ends within so long is told of."""

PEM_END = "-----END CERTIFICATE-----"

CERTIFICATES = ("root_ca_certificate", "listen_certificate", "connect_certificate")
PAIRS = (("listen_certificate", "listen_private_key"), ("connect_certificate", "connect_private_key"))


def certificates(config: zenoh.Config, now: datetime) -> list[Finding]:
    """Findings on every file that the session's configuration names, each once."""
    files = {name: setting(config, f"transport/link/tls/{name}") for name in {*CERTIFICATES, *sum(PAIRS, ())}}
    named = sorted({(files[name], name == CERTIFICATES[0]) for name in CERTIFICATES if files[name]})
    findings = [_file(Path(path), now, any_will_do=is_authority) for path, is_authority in named]
    for certificate, key in sorted({(files[one], files[two]) for one, two in PAIRS if files[one] and files[two]}):
        findings.append(_pair(certificate, key))
    return findings


def _file(path: Path, now: datetime, *, any_will_do: bool) -> Finding:
    """How a PEM file stands to the time: of a chain all must hold, of several authorities the one that holds longest
    counts."""
    try:
        blocks = [block + PEM_END for block in path.read_text(encoding="ascii").split(PEM_END)[:-1]]
        spans = [validity(ssl.PEM_cert_to_DER_cert(block[block.index("-----BEGIN") :])) for block in blocks]
    except (OSError, ValueError, IndexError) as error:
        return Finding("certificates", "wrong", f"{path}: no certificate can be read ({error})", "make it anew")
    if not spans:
        return Finding("certificates", "wrong", f"{path}: holds no certificate in PEM form", "make it anew")
    if any_will_do:
        begin, end = max(spans, key=lambda span: span[1])
    else:
        begin, end = max(span[0] for span in spans), min(span[1] for span in spans)
    if now < begin:
        mend = "set this machine's clock, or wait"
        return Finding("certificates", "wrong", f"{path}: is valid from {begin:%Y-%m-%d %H:%M} UTC only", mend)
    if now >= end:
        return Finding("certificates", "wrong", f"{path}: ended {end:%Y-%m-%d %H:%M} UTC", "make it anew")
    told = f"{path}: valid until {end:%Y-%m-%d}, {(end - now).days} days more"
    if end - now < SOON:
        return Finding("certificates", "note", told, "make it anew in time; links are closed when it ends")
    return Finding("certificates", "ok", told)


def _pair(certificate: str, key: str) -> Finding:
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password=lambda: b"")
    except (OSError, ValueError) as error:
        told = getattr(error, "reason", None) or getattr(error, "strerror", None) or error
        mend = "the key must be the one that the certificate was made for, unencrypted, and readable"
        return Finding("certificates", "wrong", f"{key} is no key for {certificate} ({told})", mend)
    if Path(key).stat().st_mode & 0o077:
        return Finding("certificates", "note", f"{key} can be read by others", f"chmod 600 {key}")
    return Finding("certificates", "ok", f"{key} is the key of {certificate}")


def validity(der: bytes) -> tuple[datetime, datetime]:
    """From when until when a certificate holds (RFC 5280, 4.1). ValueError or IndexError for what is none.

    Read by hand, since Python's ssl tells the dates only of a certificate that it trusts, which an ended one is not.
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
    """Where the content of the DER value at ``at`` begins and ends."""
    length, begin = der[at + 1], at + 2
    if length & 0x80:
        size = length & 0x7F
        length, begin = int.from_bytes(der[begin : begin + size], "big"), begin + size
    if begin + length > len(der):
        raise ValueError("it is cut off")
    return begin, begin + length


def _time(der: bytes, at: int) -> datetime:
    """UTCTime (two digits of the year, 1950 to 2049) or GeneralizedTime."""
    begin, end = _inside(der, at)
    text = der[begin:end].decode("ascii")
    if der[at] == 0x17:
        text = ("19" if text[:2] >= "50" else "20") + text
    return datetime.strptime(text, "%Y%m%d%H%M%SZ").replace(tzinfo=UTC)
