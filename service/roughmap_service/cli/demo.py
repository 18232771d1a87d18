"""`roughmap demo`: the whole job once, on this machine, with the truth known."""

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import click

from roughmap_service.cli.options import BadUse, json_option

if TYPE_CHECKING:
    from roughmap_service.cli.demo_run import Outcome

CONFIG_NAME = "demo.toml"
"""Also the mark of a folder that an earlier demo made, and that this one may clear."""


@click.command
@click.option("--seconds", type=click.FloatRange(2, 3600), default=20.0, show_default=True, help="How long to drive.")
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("demo"),
    show_default=True,
    help="Folder for log, pictures and configuration; an earlier demo's is cleared.",
)
@click.option("--robots", type=click.IntRange(1, 4), default=1, show_default=True, help="Number of rovers.")
@click.option("--seed", type=click.IntRange(0, 2**31), default=1, show_default=True, help="Of ground and noise.")
@json_option
def demo(seconds: float, out: Path, robots: int, seed: int, as_json: bool) -> int:
    """roughmap demo

    Start a service of its own (a free port on loopback), drive a simulated rover whose scans and poses go to it,
    ask it for 20 x 20 m of ground again and again meanwhile, stop it, replay its log, and compare: the replayed map
    with the served one, and the heights with the simulated truth. Ends with a table, the word `equal` and pictures;
    exit 1 if anything differed.
    """
    from roughmap_service.cli.demo_run import run_demo
    from roughmap_service.cli.options import load_pictures

    load_pictures()  # say now, not after the drive, that they can't be drawn
    _clear(out)
    outcome = run_demo(out, out / CONFIG_NAME, seconds=seconds, robots=robots, seed=seed, say=_say)
    if as_json:
        click.echo(json.dumps(outcome.as_dict()))
    else:
        _table(outcome)
    return 1 if outcome.differences else 0


def _say(text: str) -> None:
    click.echo(f"  {text}", err=True)


def _clear(out: Path) -> None:
    """Make the folder; empty what an earlier demo left there and nothing else."""
    if out.is_dir() and any(out.iterdir()) and not (out / CONFIG_NAME).is_file():
        raise BadUse(f"{out} holds other files: choose another folder with --out")
    out.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(out / "log", ignore_errors=True)
    for file in (*out.glob("*.png"), *out.glob("*.txt"), out / CONFIG_NAME):
        file.unlink(missing_ok=True)


def _table(outcome: "Outcome") -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold")
    table.add_column()
    for name, value in outcome.rows():
        table.add_row(name, value)
    console = Console(soft_wrap=True, highlight=False)
    console.print()
    console.print(table)
    console.print()
    for difference in outcome.differences:
        click.echo(f"differs: {difference}")
    click.echo(outcome.replay_line)
    click.echo("pictures: " + ", ".join(str(picture) for picture in outcome.pictures))
    click.echo(f"log, for Foxglove or `roughmap replay`: {outcome.log_directory}")
