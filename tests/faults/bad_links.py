"""Between client and service: a TCP proxy that cuts and holds up, and a relay that loses and doubles messages."""

import random
import socket
import threading
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import zenoh
from net import locators, open_listener, peer_config
from processes import T0, Service, inputs_in, replay
from report import Trial

from roughmap_client import RoughMapClient
from roughmap_schemas import Receipt, encode_cloud

PATIENCE_S = 60.0
"""How long a client goes on: many times what any fault here lasts."""


class Proxy:
    """Hands bytes on between clients and ``port``; a context manager."""

    def __init__(self, port: int) -> None:
        self.to = port
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._server.getsockname()[1]
        self._flows = threading.Event()
        self._flows.set()
        self._lock = threading.Lock()
        self._open: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """Break all connections."""
        with self._lock:
            ends, self._open = self._open, []
        for end in ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def hold(self) -> None:
        """Let no byte through until `release`."""
        self._flows.clear()

    def release(self) -> None:
        """Let bytes through again."""
        self._flows.set()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._server.accept()
            except OSError:
                return
            try:
                service = socket.create_connection(("127.0.0.1", self.to), 5.0)
            except OSError:
                client.close()
                continue
            with self._lock:
                self._open += [client, service]
            for pair in ((client, service), (service, client)):
                threading.Thread(target=self._pump, args=pair, daemon=True).start()

    def _pump(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(1 << 16):
                self._flows.wait(PATIENCE_S)
                target.sendall(data)
        for end in (source, target):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()
        self._server.close()
        self.cut()


def _message(number: int) -> bytes:
    points = np.random.default_rng(number).uniform(-3.0, 3.0, (50, 3))
    return encode_cloud(points, T0 + number * 1000, "map")


def torn_links(trial: Trial, folder: Path, rng: random.Random, number: int) -> None:
    """A client hands in 5 messages for each of ``number`` faults of its link, one of them a kill of the service."""
    sent: dict[bytes, Receipt] = {}
    with ExitStack() as stack:
        service = stack.enter_context(Service(folder))
        proxy = stack.enter_context(Proxy(_port(service)))
        client = stack.enter_context(RoughMapClient("site", [f"tcp/127.0.0.1:{proxy.port}"], timeout=PATIENCE_S))
        for n in range(number):
            kind = "kill" if n == number // 2 else rng.choice(("cut", "cut", "hold", "hold and cut"))
            worker = threading.Thread(target=_hand_in, args=(client, sent, range(5 * n, 5 * n + 5)), daemon=True)
            worker.start()
            threading.Event().wait(rng.uniform(0.0, 0.1))
            if "hold" in kind:
                proxy.hold()
                threading.Event().wait(rng.uniform(0.1, 2.5))  # beyond the time after which it sends again
            if "cut" in kind:
                proxy.cut()
            if kind == "kill":
                service.kill()
                proxy.cut()
                service = stack.enter_context(Service(folder, zenoh={"listen": [f"tcp/127.0.0.1:{proxy.to}"]}))
                service.ready()
            proxy.release()
            worker.join(PATIENCE_S)
            trial.expect(not worker.is_alive(), f"{kind}: the client still waits")
            trial.once(kind)
        trial.expect(service.stop() == 0, f"the end: {service.err[-3:]}")
    _once(trial, folder / "log", sent, 5 * number)


def _hand_in(client: RoughMapClient, sent: dict[bytes, Receipt], numbers: range) -> None:
    for number in numbers:
        payload = _message(number)
        sent[payload] = client.ingest(payload, "r1")


def _port(service: Service) -> int:
    return int(service.ready()["endpoints"][0].rsplit(":", 1)[1])


def _once(trial: Trial, log: Path, sent: dict[bytes, Receipt], number: int) -> None:
    """Each message has a receipt, and the log has each once, under its number."""
    trial.expect(len(sent) == number, f"{len(sent)} of {number} messages have a receipt")
    logged = inputs_in(log)
    trial.expect(len({one.data for one in logged}) == len(logged), "the log holds a message twice")
    wrong = [receipt.input for payload, receipt in sent.items() if logged[receipt.input - 1].data != payload]
    trial.expect(not wrong, f"receipts of other messages: {wrong[:5]}")
    trial.note("receipts of duplicates", sum(receipt.duplicate for receipt in sent.values()))
    code, verdict = replay(log)
    trial.expect(code == 0, f"replay: {verdict}")


class Relay:
    """Between two networks: takes requests from clients on one, and hands them to the service on the other, but not
    always, not always once, and not always in time."""

    def __init__(self, clients: zenoh.Session, service: zenoh.Session, rng: random.Random, trial: Trial) -> None:
        self._service = service
        self._rng = rng
        self._trial = trial
        self._queryable = clients.declare_queryable(
            "maps/site/ingest/*/*", zenoh.handlers.Callback(self._take, indirect=True), complete=True
        )

    def _take(self, query: zenoh.Query) -> None:
        fate = self._rng.choice(("through", "through", "lost", "doubled", "receipt lost", "late"))
        self._trial.note(fate)
        if fate == "lost":
            query.drop()
            return
        if fate == "late":
            threading.Event().wait(self._rng.uniform(0.0, 0.3))
        assert query.payload is not None
        key, payload = str(query.key_expr), query.payload.to_bytes()
        for last in (False, True) if fate == "doubled" else (True,):
            for reply in self._service.get(key, payload=payload, timeout=2.0):
                if last and fate != "receipt lost" and reply.ok is not None:
                    query.reply(key, reply.ok.payload.to_bytes(), encoding=reply.ok.encoding)
        query.drop()


def lost_messages(trial: Trial, folder: Path, rng: random.Random, number: int) -> None:
    """A client hands in ``number`` messages through a relay."""
    sent: dict[bytes, Receipt] = {}
    with ExitStack() as stack:
        service = stack.enter_context(Service(folder))
        behind = stack.enter_context(zenoh.open(peer_config(connect=service.ready()["endpoints"])))
        clients, endpoints = stack.enter_context(open_listener())
        Relay(clients, behind, rng, trial)
        assert locators(clients)
        client = stack.enter_context(RoughMapClient("site", endpoints, timeout=PATIENCE_S))
        for n in range(number):
            _hand_in(client, sent, range(n, n + 1))
            trial.once()
        trial.expect(service.stop() == 0, f"the end: {service.err[-3:]}")
    _once(trial, folder / "log", sent, number)
