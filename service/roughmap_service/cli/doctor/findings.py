"""What `roughmap doctor` finds, and how it is told."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

import click

from roughmap_service.host.log_lines import printable

Verdict = Literal["ok", "note", "wrong"]

COLOURS = {"ok": "green", "note": "yellow", "wrong": "red"}


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at: its area, how it is, in plain words, and what to do if it isn't well."""

    area: str
    verdict: Verdict
    text: str
    mend: str = ""

    def as_json(self) -> dict[str, Any]:
        """For another program."""
        return asdict(self)


def show(findings: list[Finding]) -> None:
    """Print them, each with its mend below, and how many are wrong."""
    width = max((len(finding.area) for finding in findings), default=0)
    for finding in findings:
        head = click.style(f"{finding.verdict:5}", fg=COLOURS[finding.verdict], bold=finding.verdict == "wrong")
        click.echo(f"{head}  {finding.area:{width}}  {printable(finding.text)}")
        if finding.mend:
            click.echo(f"{'':5}  {'':{width}}  -> {printable(finding.mend)}")
    wrong, notes = (sum(finding.verdict == verdict for finding in findings) for verdict in ("wrong", "note"))
    click.echo(f"{wrong} wrong, {notes} to note, {len(findings) - wrong - notes} ok")
