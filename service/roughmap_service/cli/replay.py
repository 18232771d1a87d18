"""`roughmap replay`: integrate a log again and compare with the logged results."""

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


OTHER_STATE_VERSION = 3
"""Exit code for a log whose digests can't be compared."""


@click.command()
@click.argument("logs", nargs=-1, required=True, type=click.Path(path_type=Path, exists=True), metavar="LOG...")
@click.option("--from", "from_store", type=click.Path(path_type=Path, exists=True, dir_okay=False), metavar="MAP.DB",
              help="Store from which the logs continue, if they do not begin with the run.")  # fmt: skip
@click.option("-o", "--out", type=click.Path(path_type=Path), metavar="MAP.DB", help="Store the resulting map.")
@click.option("--log-out", type=click.Path(path_type=Path, file_okay=False), metavar="DIR",
              help="Write the replay as a log into this empty or new folder.")  # fmt: skip
@click.option("--what-if", "changes", type=setting, multiple=True, metavar="KEY=VALUE",
              help="Also integrate with another setting, for example map.cell_size=0.2. Can be repeated.")  # fmt: skip
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

    Integrate the logs of a run again (files or folders) and compare every event and checkpoint with the logged one.
    The last line is `equal: ...` (exit code 0) or `differs at sequence ...` (exit code 1). The exit code is 2 if the
    logs are not one complete run, and 3 if they are of another state version: their digests can't be compared, and
    the last line is `not comparable: ...`.

    With --what-if the run is integrated a second time with other settings, and the two maps are compared.
    """
    from roughmap_service.journal.run_files import find_files, one_run
    from roughmap_service.offline.replay import config_of
    from roughmap_service.offline.replay import replay as run
    from roughmap_service.offline.replay_log import check_empty

    found = one_run(find_files(logs), logs)
    total = [file.path for file in found]
    if changes and from_store is not None:
        raise BadUse("--what-if needs the whole run: the store of --from was made with other settings")
    if log_out is not None and from_store is not None:
        raise BadUse("--log-out needs the whole run: a log that continues from a store can't be replayed alone")
    if out is not None and out.exists():
        raise BadUse(f"{out} exists; name another file")
    if log_out is not None:
        try:
            check_empty(log_out)
        except FileExistsError as error:
            raise BadUse(f"{log_out} {error.strerror}") from None
    change = partial(_changed, changes=changes)
    change(config_of(found[0]))  # so that a wrong setting ends the command before the work
    with _progress("replay", total) as watch:
        done = run(logs, from_store=from_store, watch=watch)
    equal = done.difference is None if done.comparable else None
    result: dict[str, Any] = {"verdict": done.verdict, "equal": equal, "events": done.events}
    if done.difference is None:
        shown = done.run
        if changes:
            shown, result["what_if"] = _what_if(logs, total, change, done.run, changes, as_json=as_json)
        if out is not None:
            # With a run id of its own: under the logged run's, a service would apply the log to it once more.
            _store(out, shown, change(done.config), uuid.uuid4().hex)
        if log_out is not None:
            _log(logs, total, log_out, change)
    elif changes or out is not None or log_out is not None:
        click.echo("the replay stopped at the first difference; the other options were not carried out", err=True)
    click.echo(json.dumps(result) if as_json else done.verdict)
    return 1 if done.difference is not None else 0 if done.comparable else OTHER_STATE_VERSION


def _what_if(
    logs: tuple[Path, ...],
    files: list[Path],
    change: "Callable[[Config], Config]",
    before: "Run",
    changes: tuple[tuple[str, object], ...],
    *,
    as_json: bool,
) -> "tuple[Run, list[dict[str, Any]]]":
    """Integrate the run with other settings; return its state and the difference of each layer."""
    from roughmap_service.offline.compare import compare
    from roughmap_service.offline.replay import what_if

    with _progress("what if", files) as watch:
        now = what_if(logs, change, watch=lambda step, _run: watch(step))
    differences = compare(before.map, now.map)
    if not as_json:
        _print_differences(differences, dict(changes))
    return now, [asdict(difference) for difference in differences]


def _changed(config: "Config", changes: tuple[tuple[str, object], ...]) -> "Config":
    """Return the settings with ``changes`` over them; BadUse for an unknown key or a bad value."""
    from pydantic import ValidationError

    from roughmap_schemas import Config

    values = config.public_dict()
    if "map.surface" in dict(changes):  # the limits of the other surface have other names
        values["map"].pop("limits")
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

    shown = ", ".join(f"{key}={value}" for key, value in changes.items())
    table = Table(title=f"map with {shown}, compared with the logged map")
    for heading in ("layer", "known in both", "only in logged", "only in new", "median logged", "median new",
                    "median change", "95 % change by less than"):  # fmt: skip
        table.add_column(heading, justify="left" if heading == "layer" else "right")
    for d in differences:
        table.add_row(
            d.layer, str(d.cells), str(d.only_before), str(d.only_now), f"{d.median_before:.5g}", f"{d.median_now:.5g}",
            f"{d.median_change:+.3g}", f"{d.p95_abs_change:.3g}",
        )  # fmt: skip
    console = Console()
    if not console.is_terminal:
        console.width = 200  # a file or a pipe has no width, so nothing need be cut
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
    """Show files done and clouds integrated on stderr; one line per file if stderr is not a terminal."""
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
