"""`roughmap replay`."""

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .options import BadUse, json_option, setting

if TYPE_CHECKING:
    from roughmap_schemas import Config
    from roughmap_service.apply import RunState
    from roughmap_service.fold import Step


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
    from roughmap_service.log_reader import find_files, one_run
    from roughmap_service.replay import replay as run

    total = one_run(find_files(logs))
    if changes and from_store is not None:
        raise BadUse("--what-if needs the whole run: it can't begin from a store of other settings")
    with ExitStack() as stack:
        watch = stack.enter_context(_progress("replay", [file.path for file in total]))
        done = run(logs, from_store=from_store, watch=watch)
    state, config = done.state, done.config
    result: dict[str, Any] = {"verdict": done.verdict, "equal": done.difference is None, "events": done.events}
    if changes and done.difference is None:
        state, config, result["what_if"] = _what_if(logs, changes, done.state, config, as_json=as_json)
    if out is not None:
        _store(out, state, config, done.run)
    if log_out is not None:
        _log(logs, log_out, config)
    if as_json:
        import json

        click.echo(json.dumps(result))
    else:
        click.echo(done.verdict)
    return 0 if done.difference is None else 1


def _what_if(
    logs: tuple[Path, ...],
    changes: tuple[tuple[str, object], ...],
    before: "RunState",
    config: "Config",
    *,
    as_json: bool,
) -> "tuple[RunState, Config, list[dict[str, Any]]]":
    """The run under other settings, and a table of how each layer differs."""
    from roughmap_service.replay import what_if
    from roughmap_service.replay_compare import compare

    changed = _changed(config, changes)
    with _progress("what if", list(logs)) as watch:
        now = what_if(logs, changed, watch=lambda step, _state: watch(step))
    differences = compare(before.map, now.map)
    if not as_json:
        _print_differences(differences, dict(changes))
    return now, changed, [asdict(difference) for difference in differences]


def _changed(config: "Config", changes: tuple[tuple[str, object], ...]) -> "Config":
    from pydantic import ValidationError

    from roughmap_schemas import Config

    values = config.public_dict()
    for key, value in changes:
        place = values
        *sections, name = key.split(".")
        for section in sections:
            place = place.get(section, {})
        if name not in place:
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
    Console().print(table)


def _store(out: Path, state: "RunState", config: "Config", run: str) -> None:
    from roughmap_schemas import configuration_digest
    from roughmap_service.store import Store

    if out.exists():
        raise BadUse(f"{out} is there already; name another file")
    Store(out).write_map(state.map, config.public_dict(), configuration_digest(config), run)


def _log(logs: tuple[Path, ...], directory: Path, config: "Config") -> None:
    from roughmap_service.replay import what_if
    from roughmap_service.replay_log import ReplayLog

    with ExitStack() as stack:
        watch = stack.enter_context(_progress("log", list(logs)))
        written: list[ReplayLog] = []

        def write(step: "Step", state: "RunState") -> None:
            if not written:
                written.append(stack.enter_context(ReplayLog(directory, config, state)))
            written[0].take(step)
            watch(step)

        what_if(logs, config, watch=write)


@contextmanager
def _progress(title: str, files: list[Path]) -> "Iterator[Callable[[Step], None]]":
    """A progress line on stderr: files done, clouds integrated; plain lines where stderr is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from roughmap_service.log_reader import EventRecord, FileStart

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
