#!/usr/bin/env python3
"""Make certificates to try out access control: an authority, a router, a service, and one for each role and robot.

    python docker/certificates.py certificates --host map.example.org --robot rover1 --robot rover2

writes PEM files into the folder `certificates`. Run again, it adds the missing ones. The rules in
docker/access/router.json5 use the common name (CN) of a certificate, which is its file name. Keys are unencrypted and
readable by you only. The holder of authority.key can pose as anyone: keep it off the robots. If your fleet has an
authority of its own, use that one instead.
"""

import argparse
import datetime as dt
import ipaddress
import os
import re
import sys
from pathlib import Path

try:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
except ImportError:
    sys.exit("certificates.py needs the cryptography package: pip install cryptography")

AUTHORITY = "authority"
SERVERS = ("router", "service")
ROLES = ("planner", "operator")
DAY = dt.timedelta(days=1)
NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
LOOPBACK = ("localhost", "127.0.0.1", "::1")


def main() -> None:
    """Read the command line and make what is missing."""
    first, rest = (__doc__ or "").split("\n", 1)
    parser = argparse.ArgumentParser(
        description=first, epilog=rest, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="output folder; created if missing")
    parser.add_argument("--host", action="append", default=[], help="name or IP of router and service; repeatable")
    parser.add_argument("--robot", action="append", default=[], help="name of a robot; repeatable")
    parser.add_argument("--days", type=int, default=365, help="days of validity (default: %(default)s)")
    parser.add_argument("--expired", action="store_true", help="for tests: make certificates that expired an hour ago")
    chosen = parser.parse_args()
    for robot in chosen.robot:
        if not NAME.fullmatch(robot) or robot in (AUTHORITY, *SERVERS, *ROLES):
            parser.error(f"--robot {robot!r}: expected {NAME.pattern}, and not the name of a role")
    made = make(chosen.folder, chosen.host, chosen.robot, chosen.days, expired=chosen.expired)
    print(f"{chosen.folder}: made {', '.join(made) or 'nothing, all exist'}")


def make(folder: Path, hosts: list[str], robots: list[str], days: float = 365, *, expired: bool = False) -> list[str]:
    """Make the missing certificates in ``folder``; returns their names."""
    now = dt.datetime.now(dt.UTC)
    end = now - DAY / 24 if expired else now + days * DAY
    folder.mkdir(parents=True, exist_ok=True)
    made = []
    if not (folder / f"{AUTHORITY}.pem").exists():
        key = ec.generate_private_key(ec.SECP256R1())
        extensions: list[tuple[x509.ExtensionType, bool]] = [
            (x509.BasicConstraints(ca=True, path_length=0), True),
            (_usage(signs_certificates=True), True),
        ]
        # Valid from two days ago, because robots' clocks may be late, and longer than any certificate that it signs.
        authority = _signed(key, AUTHORITY, _name(AUTHORITY), key, now - 2 * DAY, now + 3650 * DAY, extensions)
        _write(folder, AUTHORITY, key, authority)
        made.append(AUTHORITY)
    signing = serialization.load_pem_private_key((folder / f"{AUTHORITY}.key").read_bytes(), None)
    if not isinstance(signing, ec.EllipticCurvePrivateKey):
        sys.exit(f"{folder / AUTHORITY}.key: expected an elliptic-curve key, as this program makes")
    issuer = x509.load_pem_x509_certificate((folder / f"{AUTHORITY}.pem").read_bytes()).subject
    for name in (*SERVERS, *ROLES, *robots):
        if (folder / f"{name}.pem").exists():
            continue
        purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
        extensions = [(x509.BasicConstraints(ca=False, path_length=None), True), (_usage(), True)]
        if name in SERVERS:  # only these can act as servers, so that no robot can pose as the router
            purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
            extensions.append((x509.SubjectAlternativeName([_host(host) for host in (*LOOPBACK, *hosts)]), False))
        extensions.append((x509.ExtendedKeyUsage(purposes), False))
        key = ec.generate_private_key(ec.SECP256R1())
        _write(folder, name, key, _signed(signing, name, issuer, key, now - 2 * DAY, end, extensions))
        made.append(name)
    return made


def _signed(
    signing: ec.EllipticCurvePrivateKey,
    name: str,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    begin: dt.datetime,
    end: dt.datetime,
    extensions: list[tuple[x509.ExtensionType, bool]],
) -> x509.Certificate:
    builder = (
        x509.CertificateBuilder()
        .subject_name(_name(name))
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(begin)
        .not_valid_after(end)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signing.public_key()), critical=False)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )
    for extension, critical in extensions:
        builder = builder.add_extension(extension, critical)
    return builder.sign(signing, hashes.SHA256())


def _name(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _usage(*, signs_certificates: bool = False) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates, key_cert_sign=signs_certificates, crl_sign=signs_certificates,
        content_commitment=False, key_encipherment=False, data_encipherment=False, key_agreement=False,
        encipher_only=False, decipher_only=False,
    )  # fmt: skip


def _write(folder: Path, name: str, key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate) -> None:
    """Write the key, readable by its owner only, then the certificate: if that exists, both do."""
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    path = folder / f"{name}.key"
    path.unlink(missing_ok=True)  # left by an interrupted run
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as stream:
        stream.write(private)
    (folder / f"{name}.pem").write_bytes(certificate.public_bytes(serialization.Encoding.PEM))


if __name__ == "__main__":
    main()
