"""`roughmap serve` as a process, for tests of its clients: the command line and the README."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import zenoh
from net import WAIT_S, Gathered, peer_config

from roughmap_schemas import Event, IntegrationEvent, decode_event
from roughmap_service.cli.demo.processes import ServiceProcess


@contextmanager
def live_service(folder: Path, settings: str = "") -> Iterator[ServiceProcess]:
    """Run a service with `settings` (TOML without zenoh, log, http and service); yield it once it is ready.

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
    """Gather the service's decisions on clouds from now on."""
    gathered: Gathered[IntegrationEvent] = Gathered()

    def take(sample: zenoh.Sample) -> None:
        event: Event = decode_event(sample.payload.to_bytes())
        if isinstance(event, IntegrationEvent):
            gathered(event)

    with zenoh.open(peer_config(connect=service.endpoints)) as session:
        session.declare_subscriber(f"maps/{map_name}/events", take)
        # An answer shows that the service knows what was declared before the query, on the same link.
        assert list(session.get(f"maps/{map_name}/status", timeout=WAIT_S)), "the service does not answer"
        yield gathered
