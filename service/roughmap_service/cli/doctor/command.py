"""`roughmap doctor`: check that a service with this configuration works here and that the robots send what it needs."""

import json
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from roughmap_service.cli.doctor.findings import Finding, Verdict, show
from roughmap_service.cli.options import Failure, config_options, json_option, load

if TYPE_CHECKING:
    import zenoh

    from roughmap_client import RoughMapClient
    from roughmap_schemas.config_load import LoadedConfig
    from roughmap_schemas.messages import MapStatus

REACH_S = 2.0
"""Seconds that an endpoint may take to answer."""

STATUS_S = 10.0
"""Seconds that a running service may take to send its status: the machine may be busy."""


@click.command
@click.option(
    "--seconds",
    type=click.FloatRange(0, 600),
    default=8.0,
    show_default=True,
    help="How long to listen to the robots, in seconds; 0: do not listen.",
)
@config_options
@json_option
def doctor(seconds: float, config_path: Path | None, settings: tuple[tuple[str, object], ...], as_json: bool) -> int:
    """roughmap doctor

    Check that mapping can work with this configuration: directories, disk space and how long it lasts, memory, clock,
    ports, certificates, exposure to the network, Zenoh peers, and what the robots publish: frames, rates and losses,
    stamps and clocks, per-point times, poses, their leaps and covariances, transforms, and what clouds are made of.
    Print each finding, and below it the remedy if something is wrong, with settings to paste into the configuration
    file.

    If the service is running, doctor connects to it. If not, doctor opens the Zenoh session that it would open.
    Exit code 1 if anything is wrong.
    """
    from roughmap_service.cli.doctor import machine as doctor_machine
    from roughmap_service.cli.doctor import security as doctor_security

    loaded = load(config_path, settings)
    config = loaded.config
    source = str(loaded.path) if loaded.path is not None else "no file, defaults"
    findings = [Finding("settings", "ok", f"{source}; map {config.map.name!r}")]
    findings += doctor_machine.directories(config)
    findings += [doctor_machine.memory(config), doctor_machine.clock()]
    findings += doctor_security.zenoh_access(loaded)
    findings += [found] if (found := doctor_security.http_access(config.http)) else []
    with ExitStack() as stack:
        beside = _session(loaded, stack, listening=seconds > 0)
        findings += [doctor_machine.http_port(config, running=beside.running), *beside.findings]
        if beside.session is not None and seconds > 0:
            click.echo(f"listening for {seconds:g} s ...", err=True)
            findings += _traffic(beside, beside.session, loaded, seconds)
    wrong = any(finding.verdict == "wrong" for finding in findings)
    if as_json:
        click.echo(json.dumps({"ok": not wrong, "findings": [finding.as_json() for finding in findings]}))
    else:
        show(findings)
    return 1 if wrong else 0


class Beside(NamedTuple):
    """The session to listen on (None: there is none), whether the service is running, and what it said."""

    session: "zenoh.Session | None"
    running: bool
    findings: list[Finding]
    client: "RoughMapClient | None" = None
    status: "MapStatus | None" = None


def _session(loaded: "LoadedConfig", stack: ExitStack, *, listening: bool) -> Beside:
    """Open a session with the running service, or the one that the service would open; tell whether it is running.

    ``listening``: the service's problems are told at the end.
    """
    from roughmap_client import RoughMapClient
    from roughmap_client.errors import RoughMapError
    from roughmap_schemas.faults import ConfigFault
    from roughmap_service.cli.connection import client_config, lacks_certificate, open_client
    from roughmap_service.cli.health import served_map
    from roughmap_service.inputs.session import TransportError, open_session, zenoh_config

    config, bare = loaded.config, False
    try:
        asking = client_config(loaded, ())
        bare = lacks_certificate(asking)
        session = stack.enter_context(open_client(asking, REACH_S))
        client = RoughMapClient(config.map.name, session=session, timeout=STATUS_S, keys=config.keys)
        status = client.status()
        text = f"the service has been up for {status.uptime_s:.0f} s, health {status.health}; listening beside it"
        verdict: Verdict = "ok" if status.health == "ok" else "note" if listening and status.problems else "wrong"
        found = [Finding("zenoh", verdict, text), *_refused(status), *_peers(loaded)]
        return Beside(session, True, found, client, status)
    except (Failure, RoughMapError, ConfigFault) as error:
        stack.close()  # no service, or that of another map
        if config.http.listen is not None and served_map(config) == config.map.name:
            text = f"the service answers on http.listen, but not over Zenoh: {error}"
            remedy = "`roughmap health` says whether it is still starting; if not, check zenoh.listen"
            if bare:
                text = "the service is up; doctor has no certificate to connect to it and to receive what robots send"
                remedy = "`roughmap top --zenoh FILE` with a planner's certificate shows what comes in (SECURITY.md)"
            return Beside(None, True, [Finding("zenoh", "note", text, remedy)])
    try:
        session = stack.enter_context(open_session(zenoh_config(loaded)))
    except (TransportError, ConfigFault) as error:
        remedy = "stop the other program, or change zenoh.listen"
        return Beside(None, False, [Finding("zenoh", "wrong", str(error), remedy)])
    where = ", ".join(endpoint.partition("#")[0] for endpoint in config.zenoh.listen) or "nowhere"
    text = f"no service is running; listening in its place on {where}"
    return Beside(session, False, [Finding("zenoh", "ok", text), *_peers(loaded)])


def _refused(status: "MapStatus") -> list[Finding]:
    """Return a note if the running service refused messages."""
    if not status.refused:
        return []
    reasons = ", ".join(f"{reason} {number:,}" for reason, number in status.refused.items())
    text = f"the service has refused {sum(status.refused.values()):,} messages since its start: {reasons}"
    remedy = "its log lines (refused, stream_lost) name the robot and the cause"
    return [Finding("robots", "note", text, remedy)]


def _peers(loaded: "LoadedConfig") -> list[Finding]:
    """Connect to each endpoint of zenoh.connect by itself."""
    from roughmap_service.cli.connection import client_config, open_client

    findings = []
    for endpoint in loaded.config.zenoh.connect:
        shown = endpoint.partition("#")[0]
        begun = time.monotonic()
        try:
            open_client(client_config(loaded, [endpoint]), REACH_S).close()
        except Failure:
            remedy = "check that the router is up, the address, the firewall and the certificates"
            findings.append(Finding("zenoh", "wrong", f"zenoh.connect: {shown} is not reachable", remedy))
        else:
            text = f"zenoh.connect: {shown} answered in {(time.monotonic() - begun) * 1e3:.0f} ms"
            findings.append(Finding("zenoh", "ok", text))
    return findings


def _meanwhile(beside: Beside, told: set[str]) -> "tuple[list[Finding], MapStatus | None]":
    """Ask the running service once more: what it made of the messages, and what it calls a problem but those told."""
    from roughmap_client.errors import RoughMapError
    from roughmap_service.cli.doctor.service import judge_service

    if beside.client is None or beside.status is None:
        return [], None
    try:
        after = beside.client.status()
    except RoughMapError as error:
        return [Finding("service", "wrong", f"the service no longer answers: {error}", "look at its log lines")], None
    return judge_service(beside.status, after, told), after


def _traffic(beside: Beside, session: "zenoh.Session", loaded: "LoadedConfig", seconds: float) -> list[Finding]:
    """Listen, and judge what was heard, what the service made of it, and the log that it makes."""
    from roughmap_schemas.keys import Keys
    from roughmap_service.cli.doctor.machine import log_growth
    from roughmap_service.cli.doctor.robots import judge
    from roughmap_service.cli.doctor.ros2 import Ros2Ears
    from roughmap_service.cli.doctor.service import knows_mountings
    from roughmap_service.cli.doctor.traffic import Traffic
    from roughmap_service.run.settings import Settings

    config = loaded.config
    traffic = Traffic(Settings(config))
    wall, monotonic = time.time(), time.monotonic()
    with ExitStack() as stack:
        ears = stack.enter_context(Ros2Ears(session, config, traffic.put)) if config.ros2.robots else None
        traffic.listen(session, Keys(config.map.name, config.keys), seconds)
        on_topics = [] if ears is None else ears.judge()
    stepped = (time.time() - wall) - (time.monotonic() - monotonic)
    said, after = _meanwhile(beside, set() if ears is None else ears.told)
    findings = on_topics + judge(traffic, config, seconds, mounted=knows_mountings(beside.status, after))
    if abs(stepped) > 0.1:  # slewing stays far below a millisecond a second
        text = f"this machine's clock jumped by {stepped:+.2f} s while doctor listened"
        findings.append(Finding("clock", "wrong", text, "let a single program set it, by slewing"))
    measured = None if after is None else after.log.bytes_per_hour
    return [*findings, *said, *log_growth(config, traffic.bytes_per_hour(seconds), measured)]
