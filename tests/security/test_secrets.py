"""Secrets are looked for, as canaries, in all that the service and the commands say, write and answer."""

import json
import socket
import urllib.error
import urllib.request
from pathlib import Path

import processes
import pytest
import zenoh
from access import Certificates, by_password, example, open_router, put_settings
from net import WAIT_S, peer_config
from processes import Service, connected, toml

from roughmap_client import NoAnswer, RoughMapClient
from roughmap_client.access import add_access
from roughmap_schemas.config_load import load_config
from roughmap_schemas.faults import ConfigFault
from roughmap_service.cli.main import run

CANARY = "c4n4ry"
NO_PAGES = ("--set", "http.listen=")
"""The default port of the pages may be taken here."""

IN_ENDPOINT = f"tcp/127.0.0.1:0#password={CANARY}"


def said(capsys: pytest.CaptureFixture[str]) -> str:
    captured = capsys.readouterr()
    return captured.out + captured.err


def in_files(directory: Path) -> list[Path]:
    return [path for path in directory.rglob("*") if path.is_file() and CANARY.encode() in path.read_bytes()]


def zenoh_file(directory: Path, text: str) -> str:
    (directory / "zenoh").mkdir(exist_ok=True)
    file = directory / "zenoh" / "peer.json5"
    file.write_text(text)
    return str(file)


ENVIRONMENT = processes.environment()


@pytest.mark.parametrize("how", ["environment", "endpoints", "zenoh file"])
def test_a_running_service_tells_no_secret(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    """On stdout and stderr at its most talkative, in log and store, over Zenoh's admin space, status and HTTP."""
    settings: dict[str, object] = {"listen": [IN_ENDPOINT]}
    if how == "environment":
        monkeypatch.setattr(processes, "environment", lambda: {**ENVIRONMENT, "ROUGHMAP_ZENOH__PASSWORD": f"[{CANARY}"})
        settings = {"listen": ["tcp/127.0.0.1:0"], "user": "service"}
    elif how == "zenoh file":
        text = f'{{transport: {{auth: {{usrpwd: {{user: "service", password: "{CANARY}"}}}}}}}}'
        settings = {"listen": ["tcp/127.0.0.1:0"], "scouting": False, "config_file": zenoh_file(tmp_path, text)}
    directory = tmp_path / "service"
    with Service(
        directory,
        "--verbose",
        zenoh=settings,
        http={"listen": "127.0.0.1:0"},
        store={"path": str(directory / "map.db")},
    ) as service:
        ready = service.ready()
        answers = []
        if how == "endpoints":  # a service with a password of its own lets in who has one
            with connected(service) as feed:
                feed.cloud("r1", processes.T0, frame="map")
                for key in ("@/**", "maps/**"):
                    replies = feed.session.get(key, timeout=WAIT_S)
                    answers += [reply.ok.payload.to_bytes().decode(errors="replace") for reply in replies if reply.ok]
                assert any("locators" in answer for answer in answers)
        for page in ("/", "/metrics", "/healthz", "/readyz"):
            try:
                with urllib.request.urlopen(ready["http"].rstrip("/") + page, timeout=WAIT_S) as response:
                    answers.append(response.read().decode())
            except urllib.error.HTTPError as error:
                answers.append(error.read().decode())
        assert service.stop() == 0
    assert len(service.err) > 2
    assert CANARY not in "".join([*service.out, *service.err, *answers])
    assert [path.name for path in in_files(directory)] == (["roughmap.toml"] if how == "endpoints" else [])
    assert list(directory.glob("log/*.mcap"))


def test_config_show_and_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "roughmap.toml"
    text = f'{{transport: {{auth: {{usrpwd: {{user: "service", password: "{CANARY}"}}}}}}}}'
    zenoh_settings = {
        "listen": [IN_ENDPOINT, f"tcp/127.0.0.1:1?a={CANARY}"],
        "connect": [f"tls/map:1#root={CANARY} {CANARY};x={CANARY}"],
        "user": "service", "config_file": zenoh_file(tmp_path, text),
    }  # fmt: skip
    file.write_text(toml({"zenoh": zenoh_settings}))
    monkeypatch.setenv("ROUGHMAP_ZENOH__PASSWORD", CANARY)
    for command in (["show"], ["show", "--json"], ["check"], ["check", "--json"]):
        assert run(["config", command[0], "-c", str(file), *command[1:]]) == 0
        told = said(capsys)
        assert CANARY not in told
        if command == ["show"]:
            assert 'zenoh.password = "hidden"' in told
            assert "environment ROUGHMAP_ZENOH__PASSWORD" in told
            assert '"tls/map:1#hidden"' in told
    loaded = load_config(None, {"zenoh.user": "service"}, {"ROUGHMAP_ZENOH__PASSWORD": CANARY})
    assert CANARY not in repr(loaded), "nor in a traceback or a debugger"


@pytest.mark.parametrize(
    "text",
    [
        f'[zenoh]\npassword = "{CANARY}"\nuser = "u"',
        f'[zenoh]\nconnect = ["TLS/map:1#x={CANARY}"]',
        f'[zenoh]\nconnect = "tls/map:1#x={CANARY}"',
        f'[zenoh]\nconnect = {{a = "tls/map:1#x={CANARY}"}}',
        f'[zenoh]\nscouting = "{CANARY}"'.replace(CANARY, f"tls/map:1#x={CANARY}"),
        f'zenoh = "tls/map:1#x={CANARY}"',
        f'[zenoh]\nuser = "u"\npassword = ["{CANARY}"]',
        f'http = "{CANARY}"',
        f"[http.token]\n{CANARY} = 1",
        f'[http]\ntoken = "{CANARY}"',
        f'[zenoh]\nlisten = ["tcp/0.0.0.0:1#x={CANARY}"]',
    ],
)
def test_a_refused_file_is_not_quoted(tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str) -> None:
    file = tmp_path / "roughmap.toml"
    file.write_text(f'{text}\n[log]\ndirectory = "{tmp_path / "log"}"' if text.startswith("[") else text)
    assert run(["serve", "-c", str(file)]) == 2
    told = said(capsys)
    assert text.strip("[")[:4] in told
    assert CANARY not in told


@pytest.mark.parametrize("given", [f"zenoh.password={CANARY}", f'zenoh.password="{CANARY}"'])
def test_a_password_on_the_command_line_is_refused(capsys: pytest.CaptureFixture[str], given: str) -> None:
    """Every user of the machine sees it there."""
    assert run(["config", "show", "--set", given, "--set", "zenoh.user=u"]) == 2
    told = said(capsys)
    assert "zenoh.password_file or the environment variable ROUGHMAP_ZENOH__PASSWORD" in told
    assert CANARY not in told


@pytest.mark.parametrize(
    "text",
    [
        f'{{transport: {{auth: {{usrpwd: {{user: "u", password: "{CANARY}" oops }}}}}}}}',
        f'{{transport: {{auth: {{usrpwd: {{user: "u", password: {{"{CANARY}": 1}}}}}}}}}}',
        f'{{mode: "{CANARY}"}}', f'{{listen: {{endpoints: ["{CANARY}"]}}}}', f'{{"{CANARY}": 1}}', f"{CANARY}",
        f'{{transport: {{link: {{tls: {{enable_mtls: "{CANARY}"}}}}}}}}',
    ],
)  # fmt: skip
def test_a_bad_zenoh_file_is_not_quoted(tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str) -> None:
    file = zenoh_file(tmp_path, text)
    settings = ["--set", f"log.directory={tmp_path / 'log'}", "--set", f"zenoh.config_file={file}", *NO_PAGES]
    assert run(["serve", *settings]) == 2
    told = said(capsys)
    assert f"{file}: not a Zenoh configuration" in told
    assert CANARY not in told
    with pytest.raises(ValueError, match="not a Zenoh configuration") as fault:
        RoughMapClient("site", config=file)
    assert CANARY not in str(fault.value)


TAILS = (f"#x={CANARY}", f"#z=1;a={CANARY}", f"#x=two words {CANARY}", f"?p={CANARY}#y={CANARY}")


@pytest.mark.parametrize("endpoint", [f"{name}/127.0.0.1:1{tail}" for name in ("tcp", "nothing") for tail in TAILS])
def test_what_can_not_be_reached_is_named_without_its_settings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], endpoint: str
) -> None:
    with pytest.raises(NoAnswer, match=r"127\.0\.0\.1:1") as fault:
        RoughMapClient("site", endpoint, timeout=0.1)
    assert CANARY not in str(fault.value)
    ask = ["query", "--bbox", "0,0,1,1", "--timeout", "0.1", "--connect", endpoint]
    feed = ["simulate", "--wait", "0.1", "--rings", "4", "--columns", "8", "--connect", endpoint]
    serve = [
        "serve", "--set", f"log.directory={tmp_path / 'log'}", "--set", "zenoh.mode=client", "--set", "zenoh.listen=",
        "--set", f"zenoh.connect={json.dumps([endpoint])}", *NO_PAGES,
    ]  # fmt: skip
    for command in (ask, feed, serve):
        assert run(command) == 1, command[0]
        told = said(capsys)
        assert "127.0.0.1:1" in told
        assert CANARY not in told


def test_a_port_that_is_taken_is_named_without_its_settings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        endpoint = f"tcp/127.0.0.1:{other.getsockname()[1]}#z=1;a={CANARY}"
        listen = ["--set", f"zenoh.listen={json.dumps([endpoint])}", "--set", f"log.directory={tmp_path / 'log'}"]
        assert run(["serve", *listen, *NO_PAGES]) == 1
    told = said(capsys)
    assert "is the port in use?" in told
    assert CANARY not in told


@pytest.mark.parametrize("content", [b"", b"\n", b"\xff" + CANARY.encode(), CANARY.encode() * 1000])
def test_a_password_file_that_is_none(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "password"
    file.write_bytes(content)
    config = load_config(None, {"zenoh.user": "u", "zenoh.password_file": str(file)}).config
    with pytest.raises(ConfigFault, match=r"zenoh\.password_file") as fault:
        add_access(peer_config(), config.zenoh)
    assert CANARY not in str(fault.value)


def test_a_password_from_the_environment_opens_the_door(certificates: Certificates) -> None:
    """It is used as it is, brackets and all; the canaries above are no dead letters."""
    users = certificates.good / "odd-users.txt"
    users.write_text("planner:[odd {password}\n")
    router = put_settings(
        zenoh.Config.from_json5(example("router.json5", certificates.good)),
        **{**by_password(certificates.good), "transport__auth__usrpwd__dictionary_file": str(users)},
    )
    with open_router(certificates.good, config=router) as endpoint:
        environ = {"ROUGHMAP_ZENOH__PASSWORD": "[odd {password}"}
        given = {"zenoh.user": "planner", "zenoh.authority": str(certificates.good / "authority.pem")}
        config = put_settings(peer_config(connect=[endpoint]), mode="client", connect__timeout_ms=0)
        add_access(config, load_config(None, given, environ).config.zenoh)
        zenoh.open(config).close()
