"""Every error with a known cause ends a command with one line and the exit code of its class."""

import importlib
import pkgutil

import click
import pytest
import zenoh

import roughmap_client
import roughmap_ros
import roughmap_schemas
import roughmap_service
from roughmap_schemas.faults import ConfigFault, ReportedError
from roughmap_service.cli import main

CODES = {
    "BadArgument": 1,
    "BadAttachment": 1,
    "BadFoxgloveMessage": 1,
    "BadJson": 1,
    "BadRosMessage": 1,
    "CloudFileFault": 2,
    "ConfigFault": 2,
    "ContractError": 1,
    "ContractMismatch": 1,
    "DamagedLog": 2,
    "DamagedStore": 2,
    "ExportFault": 2,
    "Fault": 1,
    "HttpError": 2,
    "IdentityError": 2,
    "IncompleteAnswer": 1,
    "LockError": 2,
    "LogError": 2,
    "MessageFault": 1,
    "MixedInstances": 1,
    "NoAnswer": 1,
    "NobodyListens": 1,
    "OtherLogState": 2,
    "OtherStateVersion": 2,
    "PortTaken": 1,
    "QueryFault": 2,
    "QueryRefused": 1,
    "Refused": 1,
    "ReplayError": 2,
    "RoughMapError": 1,
    "RunError": 1,
    "ServeError": 2,
    "ServiceFailed": 1,
    "SpillError": 2,
    "StoreError": 2,
    "TornLog": 2,
    "TransportError": 1,
    "UnknownEventKind": 1,
    "UnreadableAnswer": 1,
    "WireError": 1,
}


def all_errors() -> dict[str, type[ReportedError]]:
    """Import every module; return all subclasses of the base by name."""
    for package in (roughmap_schemas, roughmap_client, roughmap_ros, roughmap_service):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(module.name)
    found: dict[str, type[ReportedError]] = {}
    left = [ReportedError]
    while left:
        for kind in left.pop().__subclasses__():
            found[kind.__name__] = kind
            left.append(kind)
    return found


def test_every_error_has_its_code() -> None:
    assert {name: kind.exit_code for name, kind in all_errors().items()} == CODES


@pytest.mark.parametrize(
    ("error", "code"),
    [(ReportedError, 1), (ConfigFault, 2), (OSError, 1), (zenoh.ZError, 1)],
)
def test_one_line_and_the_code(
    error: type[Exception], code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    @click.command()
    def failing() -> None:
        raise error("the cause\nand the remedy")

    monkeypatch.setattr(main, "cli", failing)
    assert main.run([]) == code
    assert tuple(capsys.readouterr()) == ("", "roughmap: the cause and the remedy\n")
