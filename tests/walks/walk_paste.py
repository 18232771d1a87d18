"""Doctor's advice, pasted into the configuration of another service: do the same faults cost nothing any more?"""

import time
import tomllib
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import walks_paths  # noqa: F401 - before what it makes importable
import zenoh
from net import WAIT_S
from processes import Service
from walk_sender import Sender, Walk, settings
from walk_trial import connected_to

from roughmap_client import RoughMapClient
from roughmap_schemas import IntegrationEvent, decode_event

GOOD = 30
"""Clouds in a row of a robot that must be in the map: more than a window of those lost before counts."""


def pasted(walks: Sequence[Walk]) -> list[Walk]:
    """Return the walks for which doctor gave settings that concern the robot or the sensor alone."""
    return [walk for walk in walks if walk.told.settings and not walk.told.settings.startswith(("[map]", "[input]"))]


def merged(base: Mapping[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested tables, those of ``more`` over those of ``base``."""
    both = dict(base)
    for name, value in more.items():
        is_table = isinstance(value, Mapping) and isinstance(both.get(name), Mapping)
        both[name] = merged(both[name], value) if is_table else value
    return both


def quoted(tables: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables with those names in quotation marks that TOML wants so."""
    bare = {name: quoted(value) if isinstance(value, Mapping) else value for name, value in tables.items()}
    return {name if name.replace("_", "").isalnum() else f'"{name.strip(chr(34))}"': v for name, v in bare.items()}


def try_pasted(folder: Path, walks: Sequence[Walk], limit: float) -> None:
    """Let the robots walk, each with its fault from the first message on, until all of their clouds are mapped."""
    tables = quoted(settings([walk.name for walk in walks]))
    for walk in walks:
        tables = merged(tables, quoted(tomllib.loads(walk.told.settings)))
    with ExitStack() as stack:
        service, _, session = stack.enter_context(connected_to(Service(folder, **tables)))
        client = RoughMapClient("site", session=session, timeout=WAIT_S)
        outcomes: dict[str, deque[str]] = {walk.name: deque(maxlen=GOOD) for walk in walks}

        def take(sample: zenoh.Sample) -> None:
            event = decode_event(sample.payload.to_bytes())
            if isinstance(event, IntegrationEvent) and event.robot in outcomes:
                outcomes[event.robot].append(str(event.outcome))

        stack.callback(session.declare_subscriber("maps/site/events", take).undeclare)
        client.status()
        for walk in walks:
            walk.silent, walk.on = False, True
        sender = Sender(session, walks)
        stack.callback(sender.stop)
        begun = time.time()
        sender.start()
        while any(walk.told.pasted is None for walk in walks) and time.time() < begun + limit:
            status = client.status()
            for walk in walks:
                last = list(outcomes[walk.name])
                problems = [text for subject, text in status.problems.items() if subject.startswith(walk.robot)]
                if last == ["integrated"] * GOOD and not problems and walk.told.pasted is None:
                    walk.told.pasted = time.time() - begun
                walk.told.said["pasted"] = f"{walk.told.settings!r}: {problems or last}"
            time.sleep(0.2)
        sender.stop()
        assert service.stop() == 0, service.err[-3:]
