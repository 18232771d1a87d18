"""What a command says where it isn't let in, or hears nothing: the hint fits the session's own settings."""

import socket
from pathlib import Path

import pytest

from roughmap_schemas.config_load import load_config
from roughmap_service.cli.connection import client_config, if_guarded
from roughmap_service.cli.main import run

ACCESS = Path(__file__).resolve().parents[2] / "docker" / "access"


def test_nothing_is_added_where_nothing_is_guarded() -> None:
    assert if_guarded(client_config(load_config(None, {}, {}), ())) == ""


def test_a_routers_own_settings_have_nothing_to_show() -> None:
    loaded = load_config(None, {"zenoh.config_file": str(ACCESS / "router.json5")}, {})
    assert "--zenoh docker/access/planner.json5" in if_guarded(client_config(loaded, ()))


def test_who_shows_a_certificate_or_a_user_may_lack_the_role() -> None:
    loaded = load_config(None, {}, {})
    told = if_guarded(client_config(loaded, (), ACCESS / "planner.json5"))
    assert "certificates/planner.pem" in told
    assert "silent" in told
    loaded = load_config(None, {"zenoh.user": "anna"}, {"ROUGHMAP_ZENOH__PASSWORD": "secret"})
    told = if_guarded(client_config(loaded, ()))
    assert "the user 'anna'" in told
    assert "secret" not in told


@pytest.mark.parametrize("which", ["http.listen", "zenoh.listen"])
def test_a_taken_port_is_no_mistake_in_the_settings(
    which: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit 1, so that a service manager tries again: it may be free by then."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = f"127.0.0.1:{other.getsockname()[1]}"
        listen = {"http.listen": "", "zenoh.listen": '["tcp/127.0.0.1:0"]'}
        listen[which] = taken if which == "http.listen" else f'["tcp/{taken}"]'
        settings = [f"--set={name}={value}" for name, value in listen.items()]
        assert run(["serve", f"--set=log.directory={tmp_path / 'log'}", *settings]) == 1
    assert which in capsys.readouterr().err
