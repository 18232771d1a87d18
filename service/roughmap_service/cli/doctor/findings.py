"""What `roughmap doctor` finds, and how it is printed."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import click

from roughmap_service.host.log_lines import printable
from roughmap_service.inputs.remedies import toml_key

Verdict = Literal["ok", "note", "wrong"]

COLOURS = {"ok": "green", "note": "yellow", "wrong": "red"}


@dataclass(frozen=True)
class Finding:
    """The result of one check: its area, what was found, and the remedy if something is wrong.

    ``settings`` are lines of TOML that the remedy means, to be pasted into the configuration.
    """

    area: str
    verdict: Verdict
    text: str
    remedy: str = ""
    settings: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return the finding as a JSON object."""
        return asdict(self)


def table(names: tuple[str, ...], values: Mapping[str, object]) -> str:
    """Return a TOML table: its name in parts, which are quoted where they must be, and its values."""
    lines = [f"[{'.'.join(toml_key(name) for name in names)}]"]
    lines += [f"{name} = {_value(value)}" for name, value in values.items()]
    return "\n".join(lines)


def _value(value: object) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple | list):
        return f"[{', '.join(_value(item) for item in value)}]"
    return repr(value)


def show(findings: list[Finding]) -> None:
    """Print the findings, each with its remedy below it, and how many are wrong."""
    width = max((len(finding.area) for finding in findings), default=0)
    for finding in findings:
        head = click.style(f"{finding.verdict:5}", fg=COLOURS[finding.verdict], bold=finding.verdict == "wrong")
        click.echo(f"{head}  {finding.area:{width}}  {printable(finding.text)}")
        if finding.remedy:
            click.echo(f"{'':5}  {'':{width}}  -> {printable(finding.remedy)}")
        for line in finding.settings.splitlines():
            click.echo(f"{'':5}  {'':{width}}       {printable(line)}")
    wrong, notes = (sum(finding.verdict == verdict for finding in findings) for verdict in ("wrong", "note"))
    click.echo(f"{wrong} wrong, {notes} {'note' if notes == 1 else 'notes'}, {len(findings) - wrong - notes} ok")
