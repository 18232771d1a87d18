"""What `roughmap doctor` finds, and how it is printed."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

import click

from roughmap_service.host.log_lines import printable

Verdict = Literal["ok", "note", "wrong"]

COLOURS = {"ok": "green", "note": "yellow", "wrong": "red"}


@dataclass(frozen=True)
class Finding:
    """The result of one check: its area, what was found, and the remedy if something is wrong."""

    area: str
    verdict: Verdict
    text: str
    remedy: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return the finding as a JSON object."""
        return asdict(self)


def show(findings: list[Finding]) -> None:
    """Print the findings, each with its remedy below it, and how many are wrong."""
    width = max((len(finding.area) for finding in findings), default=0)
    for finding in findings:
        head = click.style(f"{finding.verdict:5}", fg=COLOURS[finding.verdict], bold=finding.verdict == "wrong")
        click.echo(f"{head}  {finding.area:{width}}  {printable(finding.text)}")
        if finding.remedy:
            click.echo(f"{'':5}  {'':{width}}  -> {printable(finding.remedy)}")
    wrong, notes = (sum(finding.verdict == verdict for finding in findings) for verdict in ("wrong", "note"))
    click.echo(f"{wrong} wrong, {notes} {'note' if notes == 1 else 'notes'}, {len(findings) - wrong - notes} ok")
