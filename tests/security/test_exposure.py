"""Sessions that anyone on the network could join are refused, judged by their whole configuration."""

import json
from pathlib import Path
from typing import Any

import pytest
import zenoh
from processes import Service

from roughmap_schemas.config_load import load_config
from roughmap_schemas.faults import ConfigFault
from roughmap_service.host.exposure import exposures, is_loopback, is_private, weaknesses
from roughmap_service.inputs.session import check_exposure, zenoh_config

QUIET = {"scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}}}


def session(**settings: Any) -> zenoh.Config:
    return zenoh.Config.from_json5(json.dumps({**QUIET, **settings}))


def listening(*endpoints: str, **settings: Any) -> zenoh.Config:
    return session(listen={"endpoints": list(endpoints)}, **settings)


@pytest.mark.parametrize(
    "host", ["127.0.0.1", "127.9.9.9", "::1", "[::1]", "localhost", "LOCALHOST", "::ffff:127.0.0.1"]
)
def test_loopback(host: str) -> None:
    assert is_loopback(host)


@pytest.mark.parametrize(
    "host",
    ["0.0.0.0", "::", "[::]", "192.168.1.5", "::ffff:192.168.1.5", "", "*", "robot", "localhost.example.org",
     "127.0.0.1.example.org", "127.1", "0", "fe80::1%lo"],
)  # fmt: skip
def test_no_loopback(host: str) -> None:
    assert not is_loopback(host)


@pytest.mark.parametrize(
    ("endpoint", "private"),
    [
        ("tcp/127.0.0.1:7447", True), ("udp/[::1]:0", True), ("tcp/localhost:7447?prio=1#iface=eth0", True),
        ("unixsock-stream/tmp/x.sock", True), ("tcp/0.0.0.0:7447", False), ("tcp/[::]:7447", False),
        ("tcp/192.168.1.5:7447#iface=lo", False), ("udp/224.0.0.1:7446", False), ("serial//dev/ttyUSB0", False),
        ("vsock/-1:1234", False), ("tcp/robot:7447#x=/127.0.0.1:1", False),
    ],
)  # fmt: skip
def test_endpoints(endpoint: str, private: bool) -> None:
    assert is_private(endpoint) is private


@pytest.mark.parametrize(
    ("config", "named"),
    [
        (listening("tcp/127.0.0.1:7447"), []),
        (listening("tls/0.0.0.0:7447"), []),
        (listening("tcp/127.0.0.1:7447", "tcp/0.0.0.0:7447"), ["listen.endpoints"]),
        (listening("ws/10.0.0.1:80"), ["listen.endpoints"]),
        (listening("ws/127.0.0.1:80"), ["listen.endpoints"]),
        (session(listen={"endpoints": {"peer": ["tcp/0.0.0.0:1"], "router": []}}), ["listen.endpoints"]),
        (session(mode="router", listen={"endpoints": {"peer": ["tcp/0.0.0.0:1"], "router": []}}), []),
        (session(), ["listen.endpoints"]),  # Zenoh's own default listens everywhere
        (listening("tcp/127.0.0.1:1", scouting={"gossip": {"enabled": False}}), ["scouting.multicast"]),
        (
            listening("tls/0.0.0.0:1", scouting={"multicast": {"enabled": False}}),
            ["scouting.gossip"],  # which is on by default, and leads to peers without TLS
        ),
        (listening("tls/0.0.0.0:1", scouting={}, transport={"link": {"protocols": ["tls"]}}), []),
        (
            listening("tls/0.0.0.0:1", scouting={}, transport={"link": {"protocols": ["tls", "tcp"]}}),
            ["scouting.multicast", "scouting.gossip"],
        ),
        (listening(mode="client", connect={"endpoints": ["tls/map:1"]}, scouting={}), []),
        (listening(mode="client", scouting={}), ["scouting.multicast"]),
    ],
)
def test_exposures(config: zenoh.Config, named: list[str]) -> None:
    assert [text.partition(":")[0] for text in exposures(config)] == named


def test_weaknesses() -> None:
    tls = {"link": {"tls": {"enable_mtls": True}}}
    users = {"auth": {"usrpwd": {"dictionary_file": "users.txt"}}}
    assert weaknesses(listening("tls/0.0.0.0:7447", transport=tls)) == []
    assert weaknesses(listening("tls/0.0.0.0:7447", transport=users)) == []
    assert "tls/0.0.0.0:7447 requires neither" in weaknesses(listening("tls/0.0.0.0:7447"))[0]
    assert "tcp/map:7447 is not encrypted" in weaknesses(listening(connect={"endpoints": ["tcp/map:7447"]}))[0]


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_by_default_the_session_looks_for_nobody_and_shares_no_memory(mode: str) -> None:
    config = zenoh_config(load_config(None, {"zenoh.mode": mode}, {}))
    assert json.loads(config.get_json("listen/endpoints")) == ["tcp/127.0.0.1:7447"]
    paths = ["scouting/multicast/enabled", "transport/shared_memory/enabled"]
    paths += ["scouting/gossip/enabled"] if mode == "peer" else []
    assert [config.get_json(path) for path in paths] == ["false"] * len(paths)


def refusal(tmp_path: Path, text: str, **settings: object) -> str:
    file = tmp_path / "roughmap.toml"
    file.write_text(text)
    loaded = load_config(file, settings)
    with pytest.raises(ConfigFault) as fault:
        check_exposure(zenoh_config(loaded), loaded, insecure=False)
    return str(fault.value)


def test_the_refusal_names_setting_and_remedy(tmp_path: Path) -> None:
    told = refusal(tmp_path, '[zenoh]\nlisten = ["tcp/0.0.0.0:7447#password=CANARY"]')
    assert told.startswith("zenoh.listen: tcp/0.0.0.0:7447 is open to the network without TLS")
    assert "--insecure" in told
    assert "CANARY" not in told
    assert refusal(tmp_path, "[zenoh]\nscouting = true").startswith("zenoh.scouting: connects to any")
    assert "any page in a browser" in refusal(tmp_path, '[zenoh]\nlisten = ["ws/127.0.0.1:7448"]')


def test_a_zenoh_file_counts_too(tmp_path: Path) -> None:
    file = tmp_path / "peer.json5"
    file.write_text('{listen: {endpoints: ["tcp/0.0.0.0:0"]}, scouting: {multicast: {enabled: false}}}')
    setting = f'[zenoh]\nconfig_file = "{file}"\n'
    assert refusal(tmp_path, setting).startswith(f"zenoh.config_file {file}: listen.endpoints: tcp/0.0.0.0:0 is open")
    (tmp_path / "roughmap.toml").write_text(setting)
    loaded = load_config(tmp_path / "roughmap.toml", {"zenoh.listen": ["tcp/127.0.0.1:0"]})
    check_exposure(zenoh_config(loaded), loaded, insecure=False)  # what is given goes over the file


def test_serve_refuses_and_is_allowed(tmp_path: Path) -> None:
    """The process itself: exit 2 and one line, nothing made; with --insecure a warning and the start goes on."""
    wide = {"listen": ["tcp/0.0.0.0:0"]}
    with Service(tmp_path / "refused", zenoh=wide) as service:
        assert service.finished(60) == 2
        assert "tcp/0.0.0.0:0 is open to the network without TLS" in service.err[-1]
        assert not service.log.exists()
    # 127.1 is loopback to the system, but nothing that we call so: no test listens on the network.
    with Service(tmp_path / "allowed", "--insecure", zenoh={"listen": ["tcp/127.1:0"]}) as service:
        assert service.ready()["endpoints"]
        assert service.stop() == 0
        assert sum("insecure: listen.endpoints: tcp/127.1:0" in line for line in service.err) == 1, service.err
