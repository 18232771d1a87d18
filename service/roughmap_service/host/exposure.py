"""Which Zenoh settings expose the service to the network."""

import ipaddress
import re

import zenoh

from roughmap_client.access import endpoints_of, setting

ENCRYPTED = frozenset({"tls", "quic"})
ON_THIS_MACHINE = frozenset({"unixsock-stream", "unixpipe"})


def is_loopback(host: str) -> bool:
    """Return whether an address is reached only from this machine: a loopback IP (``[::1]`` too) or ``localhost``.

    Other names are not looked up, since their addresses may change after the start.
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
    """Return whether a Zenoh endpoint stays on this machine."""
    protocol, _, rest = endpoint.partition("/")
    address = re.split(r"[?#]", rest, maxsplit=1)[0]
    return protocol in ON_THIS_MACHINE or is_loopback(address.rpartition(":")[0])


def is_encrypted(endpoint: str) -> bool:
    """Return whether a Zenoh endpoint is encrypted."""
    return endpoint.partition("/")[0] in ENCRYPTED


def exposures(config: zenoh.Config) -> list[str]:
    """Return the settings of a session that let in anyone on the network without TLS, each with its reason.

    Each text begins with the path of the Zenoh setting.
    """
    found = []
    for endpoint in endpoints_of(config, "listen"):
        shown = f"listen.endpoints: {endpoint.partition('#')[0]} is open to"
        if not is_private(endpoint) and not is_encrypted(endpoint):
            found.append(f"{shown} the network without TLS")
        elif endpoint.startswith("ws/"):  # browsers speak it, and Zenoh does not check the origin of a page
            found.append(f"{shown} any page in a browser of this machine")
    mode = setting(config, "mode") or "peer"
    protocols = setting(config, "transport/link/protocols")
    if protocols and ENCRYPTED.issuperset(protocols):
        return found
    scouts = mode != "client" or not endpoints_of(config, "connect")  # a client with an endpoint has no need to
    if scouts and setting(config, "scouting/multicast/enabled") is not False:  # on by default
        found.append("scouting.multicast: connects to any Zenoh program on the network without TLS")
    beyond = [one for which in ("listen", "connect") for one in endpoints_of(config, which) if not is_private(one)]
    if mode == "peer" and beyond and setting(config, "scouting/gossip/enabled") is not False:
        # A neighbour may name any address, and a peer connects to it, past the access control of a router.
        found.append("scouting.gossip: connects to any peer that another one names, without TLS")
    return found


def weaknesses(config: zenoh.Config) -> list[str]:
    """Return what is allowed but deserves a warning: anyone may connect, or links to other machines are unencrypted."""
    found = []
    open_to = [one for one in endpoints_of(config, "listen") if not is_private(one) and is_encrypted(one)]
    checks = setting(config, "transport/link/tls/enable_mtls") or setting(
        config, "transport/auth/usrpwd/dictionary_file"
    )
    if open_to and not checks:
        found.append(f"{open_to[0].partition('#')[0]} requires neither a certificate nor a password (zenoh.authority)")
    plain = [one for one in endpoints_of(config, "connect") if not is_private(one) and not is_encrypted(one)]
    if plain:
        found.append(f"the link to {plain[0].partition('#')[0]} is not encrypted")
    return found
