"""`roughmap replay`."""

import json
import sys
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from roughmap_service.cli.options import BadUse, json_option, setting

if TYPE_CHECKING:
    from roughmap_schemas import Config
    from roughmap_service.run.fold import Step
    from roughmap_service.run.run import Run


@click.command()
@click.argument("logs", nargs=-1, required=True, type=click.Path(path_type=Path, exists=True), metavar="LOG...")
@click.option("--from", "from_store", type=click.Path(path_type=Path, exists=True, dir_okay=False), metavar="MAP.DB",
              help="The store that the logs go on from, where they don't begin with the run.")  # fmt: skip
@click.option("-o", "--out", type=click.Path(path_type=Path), metavar="MAP.DB", help="Store the map that comes of it.")
@click.option("--log-out", type=click.Path(path_type=Path, file_okay=False), metavar="DIR",
              help="Write the replay as a log of its own into an empty folder.")  # fmt: skip
@click.option("--what-if", "changes", type=setting, multiple=True, metavar="KEY=VALUE",
              help="Integrate under another setting (map.cell_size=0.2) and tell how the map differs.")  # fmt: skip
@json_option
def replay(
    logs: tuple[Path, ...],
    from_store: Path | None,
    out: Path | None,
    log_out: Path | None,
    changes: tuple[tuple[str, object], ...],
    as_json: bool,
) -> int:
    """roughmap replay log/

    Integrate a run's logs again (files or folders) and compare every checkpoint and event with what was logged. The
    last line says `equal: ...` (exit 0) or `differs at sequence ...` (exit 1); exit 2 if the logs are no whole run.
    With --what-if the run is integrated a second time under other settings, and the maps are compared.
    """
    from roughmap_service.journal.run_files import find_files, one_run
    from roughmap_service.offline.replay import config_of
    from roughmap_service.offline.replay import replay as run
    from roughmap_service.offline.replay_log import check_empty

    found = one_run(find_files(logs), logs)
    total = [file.path for file in found]
    if changes and from_store is not None:
        raise BadUse("--what-if needs the whole run: it can't begin from a store of other settings")
    if log_out is not None and from_store is not None:
        raise BadUse("--log-out needs the whole run: a log that begins in a store's midst could not be replayed alone")
    if out is not None and out.exists():
        raise BadUse(f"{out} is there already; name another file")
    if log_out is not None:
        try:
            check_empty(log_out)
        except FileExistsError as error:
            raise BadUse(f"{log_out} {error.strerror}") from None
    change = partial(_changed, changes=changes)
    change(config_of(found[0]))  # a wrong setting is told before the work
    with _progress("replay", total) as watch:
        done = run(logs, from_store=from_store, watch=watch)
    result: dict[str, Any] = {"verdict": done.verdict, "equal": done.difference is None, "events": done.events}
    if done.difference is None:
        shown = done.run
        if changes:
            shown, result["what_if"] = _what_if(logs, total, change, done.run, changes, as_json=as_json)
        if out is not None:
            # A run of its own: a service would take this for the logged run's beginning, and fold the log once more.
            _store(out, shown, change(done.config), uuid.uuid4().hex)
        if log_out is not None:
            _log(logs, total, log_out, change)
    elif changes or out is not None or log_out is not None:
        click.echo("the replay ended at the first difference: nothing else was done", err=True)
    click.echo(json.dumps(result) if as_json else done.verdict)
    return 0 if done.difference is None else 1


def _what_if(
    logs: tuple[Path, ...],
    files: list[Path],
    change: "Callable[[Config], Config]",
    before: "Run",
    changes: tuple[tuple[str, object], ...],
    *,
    as_json: bool,
) -> "tuple[Run, list[dict[str, Any]]]":
    """The run under other settings, and a table of how each layer differs."""
    from roughmap_service.offline.compare import compare
    from roughmap_service.offline.replay import what_if

    with _progress("what if", files) as watch:
        now = what_if(logs, change, watch=lambda step, _run: watch(step))
    differences = compare(before.map, now.map)
    if not as_json:
        _print_differences(differences, dict(changes))
    return now, [asdict(difference) for difference in differences]


def _changed(config: "Config", changes: tuple[tuple[str, object], ...]) -> "Config":
    """The settings with ``changes`` over them; BadUse for what is none."""
    from pydantic import ValidationError

    from roughmap_schemas import Config

    values = config.public_dict()
    for key, value in changes:
        place: Any = values
        *sections, name = key.split(".")
        for section in sections:
            place = place.get(section) if isinstance(place, dict) else None
        if not isinstance(place, dict) or name not in place:
            raise BadUse(f"--what-if {key}: no such setting; see `roughmap config show`")
        place[name] = value
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        raise BadUse(f"--what-if {'.'.join(str(part) for part in first['loc'])}: {first['msg']}") from None


def _print_differences(differences: "list[Any]", changes: dict[str, object]) -> None:
    from rich.console import Console
    from rich.table import Table

    told = ", ".join(f"{key}={value}" for key, value in changes.items())
    table = Table(title=f"the map with {told}, beside the logged one")
    for heading in ("layer", "places both know", "only logged", "only now", "median logged", "median now",
                    "median change", "95 % change less than"):  # fmt: skip
        table.add_column(heading, justify="left" if heading == "layer" else "right")
    for d in differences:
        table.add_row(
            d.layer, str(d.cells), str(d.only_before), str(d.only_now), f"{d.median_before:.5g}", f"{d.median_now:.5g}",
            f"{d.median_change:+.3g}", f"{d.p95_abs_change:.3g}",
        )  # fmt: skip
    console = Console()
    if not console.is_terminal:
        console.width = 200  # a file or a pipe has no width that names of layers would have to be cut for
    console.print(table)


def _store(out: Path, run: "Run", config: "Config", run_id: str) -> None:
    from roughmap_schemas import configuration_digest
    from roughmap_service.store.map_db import Store

    Store(out).write_map(run.map, config.public_dict(), configuration_digest(config), run_id)


def _log(logs: tuple[Path, ...], files: list[Path], directory: Path, change: "Callable[[Config], Config]") -> None:
    from roughmap_service.offline.replay import what_if
    from roughmap_service.offline.replay_log import ReplayLog

    with _progress("log", files) as watch, ReplayLog(directory) as written:

        def write(step: "Step", run: "Run") -> None:
            written.take(step, run)
            watch(step)

        what_if(logs, change, watch=write)


@contextmanager
def _progress(title: str, files: list[Path]) -> "Iterator[Callable[[Step], None]]":
    """A progress line on stderr: files done, clouds integrated; plain lines where stderr is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from roughmap_service.journal.records import EventRecord, FileStart

    console = Console(file=sys.stderr)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("files"),
               TextColumn("{task.fields[clouds]} clouds"), TimeElapsedColumn())  # fmt: skip
    with Progress(*columns, console=console, transient=not console.is_terminal, disable=not console.is_terminal) as bar:
        task = bar.add_task(title, total=len(files), clouds=0)
        clouds = files_seen = 0

        def watch(step: "Step") -> None:
            nonlocal clouds, files_seen
            if isinstance(step.item, FileStart):
                files_seen += 1
                bar.update(task, completed=max(files_seen - 1, 0))
                if not console.is_terminal:
                    click.echo(f"{title}: {step.item.path.name}", err=True)
            elif isinstance(step.item, EventRecord):
                clouds += step.item.event.kind == "integration"
                bar.update(task, clouds=clouds)

        yield watch
        bar.update(task, completed=files_seen)
