"""`roughmap serve` as a process, for tests of what stands before it: the command line and the README."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import zenoh
from net import WAIT_S, Gathered, peer_config

from roughmap_schemas import Event, IntegrationEvent, decode_event
from roughmap_service.cli.demo.processes import ServiceProcess


@contextmanager
def live_service(folder: Path, settings: str = "") -> Iterator[ServiceProcess]:
    """A service with `settings` (TOML without zenoh, log, http and service), once it is ready; `endpoints` are its own.

    At the end it must stop in order.
    """
    config = folder / "live.toml"
    config.write_text(
        f'{settings}\n[zenoh]\nlisten = ["tcp/127.0.0.1:0"]\n[log]\ndirectory = "{folder / "log"}"\n'
        '[http]\nlisten = ""\n[service]\nalive_wait = 0.2\n'
    )
    with ServiceProcess(config, folder / "live.txt") as service:
        yield service
        assert service.stop() == 0, service.last_words()


@contextmanager
def decisions(service: ServiceProcess, map_name: str = "site") -> Iterator[Gathered[IntegrationEvent]]:
    """What the service decides on clouds from now on, gathered as it comes."""
    heard: Gathered[IntegrationEvent] = Gathered()

    def take(sample: zenoh.Sample) -> None:
        event: Event = decode_event(sample.payload.to_bytes())
        if isinstance(event, IntegrationEvent):
            heard(event)

    with zenoh.open(peer_config(connect=service.endpoints)) as session:
        session.declare_subscriber(f"maps/{map_name}/events", take)
        # An answer shows that the service has what was declared before the question, on the same link.
        assert list(session.get(f"maps/{map_name}/status", timeout=WAIT_S)), "the service does not answer"
        yield heard
