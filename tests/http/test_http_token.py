"""The token comes from the environment or a file, and is shown nowhere."""

import json
from pathlib import Path

import pytest

from roughmap_schemas.config_load import load_config
from roughmap_schemas.faults import ConfigFault
from roughmap_service.cli.main import run
from roughmap_service.http.token import token_of

TOKEN = "[never shown"
VARIABLE = "ROUGHMAP_HTTP__TOKEN"


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_from_the_environment_hidden_wherever_settings_are_shown(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    config = load_config(None, {}, {VARIABLE: TOKEN}).config
    assert token_of(config.http) == TOKEN.encode()
    assert config.public_dict()["http"]["token"] == "hidden"
    assert TOKEN not in repr(config) + str(config.model_dump()) + config.model_dump_json()
    monkeypatch.setenv(VARIABLE, TOKEN)
    for arguments in (["show"], ["show", "--json"], ["check"]):
        assert run(["config", *arguments]) == 0
    out = capsys.readouterr().out
    assert "hidden" in out
    assert TOKEN not in out


def test_from_a_file(tmp_path: Path) -> None:
    (tmp_path / "token").write_text(f"{TOKEN}\n")
    config = load_config(None, {"http.token_file": "token"}, {}).config
    assert token_of(config.http) == TOKEN.encode()
    assert TOKEN not in json.dumps(config.public_dict())


def test_what_is_seen_by_others_is_refused_without_repeating_it(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(f'[http]\ntoken = "{TOKEN}"\n')
    for path, overrides, environ in (
        (tmp_path / "c.toml", {}, {}),
        (None, {"http.token": TOKEN}, {}),
        (None, {"http.token_file": "x"}, {VARIABLE: TOKEN}),
    ):
        with pytest.raises(ConfigFault) as fault:
            load_config(path, overrides, environ)
        assert "http.token_file" in str(fault.value)
        assert TOKEN not in str(fault.value)


def test_none_is_none() -> None:
    assert token_of(load_config(None, {}, {VARIABLE: ""}).config.http) is None
