"""`roughmap health`: check that the service of this configuration works.

Containers run it every few seconds, so it imports nothing heavy while http is on.
"""

import http.client
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click

from roughmap_schemas.config import Config
from roughmap_schemas.config_load import LoadedConfig
from roughmap_schemas.messages import LogState
from roughmap_service.cli.options import Failure, config_options, json_option, load, reachable
from roughmap_service.host.log_growth import GROWTH, growth_text
from roughmap_service.host.log_lines import printable
from roughmap_service.http.token import HttpError, token_of
from roughmap_service.watch.readiness import NOT_BLOCKING, SUBJECTS, Problem

TIMEOUT_S = 3.0

WORKS = {str(problem) for problem in (Problem.OVERLOADED, *NOT_BLOCKING)}
"""Problems with which a service still works. A failed check may restart the service, which would not help here."""

MAX_ANSWER = 1 << 20
"""Bytes of an answer that are read; a readiness page is smaller."""


class Found(NamedTuple):
    """The problems, each with its cause, what happened lately, and how the log grows."""

    problems: dict[str, str]
    recent: Sequence[str] = ()
    log: LogState = LogState()


@click.command
@config_options
@json_option
def health(config_path: Path | None, settings: tuple[tuple[str, object], ...], as_json: bool) -> int:
    """roughmap health

    Check that the service of this configuration works, and print a line for each problem, or ok. Lines that begin with
    "recently" tell what happened to a robot or a sensor within the last minute; the line that begins with "log" tells
    how fast the log grows, and when its disk is full. Exit code 0 if it works; 1 if it is not reachable, not ready or
    can't write its log. An overloaded service works, and so does one that can't write its store (its log has
    everything), or to which a robot sends what it can't use.

    The check reads the page /readyz. If http.listen is off or its port is 0, it asks over Zenoh.
    """
    loaded = load(config_path, settings)
    config = loaded.config
    listen = config.http.listen
    by_http = listen is not None and not listen.endswith(":0")
    try:
        problems, recent, log = _ask_page(config) if by_http else _ask_status(loaded)
    except Failure as error:
        problems, recent, log = Found({"not_there": error.message})
    works = not problems.keys() - WORKS
    if as_json:
        found = {"works": works, "map": config.map.name, "problems": problems, "recent": list(recent)}
        click.echo(json.dumps({**found, "log": log.model_dump(include=GROWTH)}))
    else:
        shown = [f"{name}: {line}" for name, cause in problems.items() for line in cause.split("\n") if line]
        shown += [name for name, cause in problems.items() if not cause]
        growth = growth_text(log.bytes_per_hour, log.hours_to_full_disk, log.keep)
        last = [f"log: {growth}"] if growth else []
        for line in [*(shown or ["ok"]), *(f"recently: {text}" for text in recent), *last]:
            click.echo(printable(f"{config.map.name}: {line}"))
    return 0 if works else 1


def served_map(config: Config) -> str | None:
    """Return the name of the map whose service answers on http.listen; None if none does."""
    try:
        answer = _page(config, "/healthz")
        return str(answer["map"])
    except (Failure, HttpError, LookupError, TypeError):
        return None


def _ask_page(config: Config) -> Found:
    """Return what the readiness page says."""
    try:
        page = _page(config, "/readyz")
        log = LogState.model_validate(page.get("log", {}))
        return Found(dict(page["problems"]), list(page.get("recent", [])), log)  # earlier versions have the first alone
    except (AttributeError, ValueError, LookupError, TypeError):
        raise _no_service(reachable(config.http.listen or "")) from None


def _no_service(where: str) -> Failure:
    return Failure(f"what answers on http://{where} is not a roughmap service; check http.listen")


def _page(config: Config, path: str) -> Any:
    """Return a page's JSON; Failure if nothing answers, or not with JSON."""
    where = reachable(config.http.listen or "")
    token = token_of(config.http)
    headers = {"Authorization": f"Bearer {token.decode()}"} if token else {}
    connection = http.client.HTTPConnection(where, timeout=TIMEOUT_S)
    try:
        connection.request("GET", path, headers=headers)
        return json.loads(connection.getresponse().read(MAX_ANSWER))
    except OSError as error:
        raise Failure(f"nobody answers on http://{where} ({error.strerror or error})") from None
    except (http.client.HTTPException, ValueError):
        raise _no_service(where) from None
    finally:
        connection.close()


def _ask_status(loaded: LoadedConfig) -> Found:
    """Return what the status over Zenoh says."""
    from roughmap_client import RoughMapClient
    from roughmap_client.errors import RoughMapError
    from roughmap_service.cli.connection import client_config, if_guarded, open_client

    config, zenoh_config = loaded.config, client_config(loaded, ())
    with open_client(zenoh_config, TIMEOUT_S) as session:
        try:
            client = RoughMapClient(config.map.name, session=session, timeout=TIMEOUT_S, keys=config.keys)
            status = client.status()
        except RoughMapError as error:
            hint = f"is the map {config.map.name!r} served there?{if_guarded(zenoh_config)}"
            raise Failure(f"{error}; {hint}") from None
    if status.health != "ok" and not status.problems:  # a service of an earlier version
        return Found({str(status.health): "the cause is in its log lines and, if http.listen is on, on /readyz"})
    found: dict[str, str] = {}
    for subject, text in status.problems.items():
        name = str(next((problem for problem, of in SUBJECTS.items() if of == subject), Problem.INPUT_LOST))
        found[name] = f"{found[name]}\n{text}" if name in found else text
    return Found(found, status.recent, status.log)
