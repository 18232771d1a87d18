"""Who can reach the service: addresses judged, and what a session would let in."""

import ipaddress
import re

import zenoh

from roughmap_client.access import endpoints_of, setting

ENCRYPTED = frozenset({"tls", "quic"})
ON_THIS_MACHINE = frozenset({"unixsock-stream", "unixpipe"})


def is_loopback(host: str) -> bool:
    """Tell whether an address is reached from this machine only: an IP of loopback, ``[::1]`` too, or ``localhost``.

    No other name is looked up: what it stands for may change after the start.
    """
    name = host.removeprefix("[").removesuffix("]").lower()
    if name == "localhost":
        return True
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        return False
    return (getattr(address, "ipv4_mapped", None) or address).is_loopback


def is_private(endpoint: str) -> bool:
    """Tell whether a Zenoh endpoint stays on this machine."""
    protocol, _, rest = endpoint.partition("/")
    address = re.split(r"[?#]", rest, maxsplit=1)[0]
    return protocol in ON_THIS_MACHINE or is_loopback(address.rpartition(":")[0])


def is_encrypted(endpoint: str) -> bool:
    """Tell whether what goes over a Zenoh endpoint is encrypted."""
    return endpoint.partition("/")[0] in ENCRYPTED


def exposures(config: zenoh.Config) -> list[str]:
    """Name what of a session lets in whoever is on the network, unencrypted; empty if nothing does.

    Each begins with the path of the Zenoh setting.
    """
    found = []
    for endpoint in endpoints_of(config, "listen"):
        shown = f"listen.endpoints: {endpoint.partition('#')[0]} is open to"
        if not is_private(endpoint) and not is_encrypted(endpoint):
            found.append(f"{shown} the network without TLS")
        elif endpoint.startswith("ws/"):  # which browsers speak, and Zenoh asks no page where it is from
            found.append(f"{shown} any page in a browser of this machine")
    mode = setting(config, "mode") or "peer"
    protocols = setting(config, "transport/link/protocols")
    if protocols and ENCRYPTED.issuperset(protocols):
        return found
    joins = mode != "client" or not endpoints_of(config, "connect")  # a client that knows whereto asks nobody
    if joins and setting(config, "scouting/multicast/enabled") is not False:  # on by default
        found.append("scouting.multicast: joins whatever Zenoh programs there are on the network, without TLS")
    beyond = [one for which in ("listen", "connect") for one in endpoints_of(config, which) if not is_private(one)]
    if mode == "peer" and beyond and setting(config, "scouting/gossip/enabled") is not False:
        # A neighbour may name any address, and a peer connects to it: around the access control of a router.
        found.append("scouting.gossip: connects to whatever peers it is told of, without TLS")
    return found


def weaknesses(config: zenoh.Config) -> list[str]:
    """Name what is allowed, but worth a warning: no check of who connects, and unencrypted links to elsewhere."""
    found = []
    open_to = [one for one in endpoints_of(config, "listen") if not is_private(one) and is_encrypted(one)]
    checks = setting(config, "transport/link/tls/enable_mtls") or setting(
        config, "transport/auth/usrpwd/dictionary_file"
    )
    if open_to and not checks:
        found.append(f"{open_to[0].partition('#')[0]} asks nobody for a certificate or password (zenoh.authority)")
    plain = [one for one in endpoints_of(config, "connect") if not is_private(one) and not is_encrypted(one)]
    if plain:
        found.append(f"what goes to {plain[0].partition('#')[0]} is not encrypted")
    return found
