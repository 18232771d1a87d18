"""The one table from errors to exit codes: each error that it names is there, and ends in its code and one line."""

import importlib

import click
import pytest

from roughmap_service.cli import main

CODES = {
    "LogError": 2,
    "TornLog": 2,
    "StoreError": 2,
    "OtherStateVersion": 2,
    "IdentityError": 2,
    "ReplayError": 2,
    "CloudFileFault": 2,
    "RunError": 1,
    "TransportError": 1,
    "HttpError": 2,
    "PortTaken": 1,
}
MODULES = (
    "journal.reader", "store.map_db", "engine.recovery", "offline.replay", "formats.clouds_in", "run.run",
    "inputs.session", "http.token", "http.server",
)  # fmt: skip


@pytest.mark.parametrize(("module", "name", "_code"), main._LATE)
def test_what_the_table_names_is_there(module: str, name: str, _code: int) -> None:
    error = getattr(importlib.import_module(module), name)
    assert issubclass(error, Exception)


@pytest.mark.parametrize("name", CODES)
def test_codes(name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    kinds = [getattr(importlib.import_module(f"roughmap_service.{module}"), name, None) for module in MODULES]
    kind = next(kind for kind in kinds if kind is not None)

    @click.command()
    def failing() -> None:
        raise kind("what is wrong\nand the mend")

    monkeypatch.setattr(main, "cli", failing)
    assert main.run([]) == CODES[name]
    out, err = capsys.readouterr()
    assert (out, err) == ("", "roughmap: what is wrong and the mend\n")
