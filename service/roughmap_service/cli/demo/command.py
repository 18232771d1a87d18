"""`roughmap demo`: service, rover, planner and replay on this machine, compared with the true world."""

import json
import shutil
import time
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

import click

from roughmap_service.cli.options import BadUse, json_option

if TYPE_CHECKING:
    from roughmap_service.cli.demo.steps import Outcome

CONFIG_NAME = "demo.toml"
"""A folder with this file was made by an earlier demo and may be cleared."""

MADE = (CONFIG_NAME, "height.png", "traversability.png", "confidence.png", "serve.txt", "simulate.txt", "replay.txt")
"""The files that a demo writes, beside its log."""


@click.command
@click.option(
    "--seconds", type=click.FloatRange(2, 3600), default=36.0, show_default=True, help="Driving time in seconds."
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("demo"),
    show_default=True,
    help="Folder for log, pictures and configuration. The files of an earlier demo are deleted.",
)
@click.option("--robots", type=click.IntRange(1, 4), default=1, show_default=True, help="Number of rovers.")
@click.option(
    "--seed", type=click.IntRange(0, 2**31), default=1, show_default=True, help="Random seed of ground and noise."
)
@json_option
def demo(seconds: float, out: Path, robots: int, seed: int, as_json: bool) -> int:
    """roughmap demo

    Start a service on a free port of this machine, drive a simulated rover that sends it scans and poses, and query
    20 x 20 m of its map five times a second. Then stop the service, replay its log, and compare the replayed map
    with the served one, and the served one with the simulated world.

    The demo prints a table and a line that begins with `equal`, and draws the map. Exit code 1 if anything differs.
    """
    from roughmap_service.cli.demo.steps import run_demo

    _clear(out)
    with _Progress(seconds) as progress:
        outcome = run_demo(out, out / CONFIG_NAME, seconds=seconds, robots=robots, seed=seed, progress=progress)
    if as_json:
        click.echo(json.dumps(outcome.as_dict()))
    else:
        _table(outcome)
    return 1 if outcome.differences else 0


class _Progress:
    """Prints each step with the seconds since the start to stderr; on a terminal, with a bar while the rover drives."""

    def __init__(self, seconds: float) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn

        console = Console(stderr=True, highlight=False)
        columns = (
            TextColumn("         driving"),
            BarColumn(),
            TextColumn("{task.completed:.0f} of {task.total:.0f} s"),
        )
        self._bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._task = self._bar.add_task("driving", total=seconds, visible=False)
        self._begun = time.monotonic()

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def step(self, text: str) -> None:
        self._bar.update(self._task, visible=False)
        self._bar.console.print(f"[{time.monotonic() - self._begun:5.1f} s] {text}", markup=False, soft_wrap=True)

    def driven(self, seconds: float) -> None:
        self._bar.update(self._task, completed=seconds, visible=True)


def _clear(out: Path) -> None:
    """Make the folder, or delete the files of an earlier demo from it; BadUse if it holds other files."""
    try:
        if out.is_dir() and any(out.iterdir()) and not (out / CONFIG_NAME).is_file():
            raise BadUse(f"--out: {out} holds other files; name another folder")
        out.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(out / "log", ignore_errors=True)
        for name in MADE:
            (out / name).unlink(missing_ok=True)
        (out / CONFIG_NAME).touch()
    except OSError as error:
        raise BadUse(f"--out: {out} is not writable: {error.strerror}; name another folder") from None


def _table(outcome: "Outcome") -> None:
    rows = outcome.rows()
    width = max(len(name) for name, _ in rows)
    click.echo()
    for name, value in rows:
        click.echo(f"{click.style(name.ljust(width), bold=True)}  {value}")
    click.echo()
    for difference in outcome.differences:
        click.echo(f"differs: {difference}")
    click.echo(f"replay: {outcome.replay_line}" if outcome.differences else outcome.replay_line)
    click.echo("pictures: " + ", ".join(str(picture) for picture in outcome.pictures))
    click.echo(f"log (open with Foxglove or `roughmap replay`): {outcome.log_directory}")
