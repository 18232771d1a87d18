"""Zenoh sessions for tests: loopback, ports chosen by the system, no scouting, every wait bounded and on an event."""

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, Generic, TypeVar

import zenoh

T = TypeVar("T")

WAIT_S = 60.0
"""How long a test waits for something that normally happens at once: long enough for a loaded machine."""


def peer_config(listen: bool = False, connect: list[str] | None = None, **settings: Any) -> zenoh.Config:
    """Return the configuration of a peer without scouting.

    `listen`: on a free port on loopback. `settings`: further Zenoh settings, with `__` for `/`.
    """
    config = zenoh.Config()
    chosen: dict[str, Any] = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": ["tcp/127.0.0.1:0"] if listen else [],
        "connect/endpoints": connect or [],
        "adminspace/enabled": True,
        "adminspace/permissions": {"read": True, "write": False},
        **{name.replace("__", "/"): value for name, value in settings.items()},
    }
    for key, value in chosen.items():
        config.insert_json5(key, json.dumps(value))
    return config


def locators(session: zenoh.Session) -> list[str]:
    """Return the endpoints of a listening session, with real ports, from its admin space."""
    for reply in session.get(f"@/{session.zid()}/peer", timeout=WAIT_S):
        if reply.ok is not None:
            return [str(locator) for locator in json.loads(reply.ok.payload.to_bytes())["locators"]]
    raise AssertionError("the session's admin space did not answer")


@contextmanager
def open_listener() -> Iterator[tuple[zenoh.Session, list[str]]]:
    """Open a listening session; yield it and its endpoints."""
    with zenoh.open(peer_config(listen=True)) as session:
        yield session, locators(session)


@contextmanager
def open_pair() -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    """Open two sessions joined over loopback TCP; yield the listening and the connected one."""
    with ExitStack() as stack:
        first, endpoints = stack.enter_context(open_listener())
        second = stack.enter_context(zenoh.open(peer_config(connect=endpoints)))
        yield first, second


def wait_for(event: threading.Event, what: str, timeout: float = WAIT_S) -> None:
    """Wait for an event; fail with its name if it doesn't come."""
    assert event.wait(timeout), f"waited {timeout:g} s in vain for {what}"


def wait_until(condition: Callable[[], T], what: str, timeout: float = WAIT_S) -> T:
    """Ask for a condition until it holds, for what has no event to wait for, and fail by name if it never does."""
    end, pause = time.monotonic() + timeout, threading.Event()
    while not (found := condition()):
        assert time.monotonic() < end, f"waited {timeout:g} s in vain for {what}"
        pause.wait(0.1)
    return found


class Gathered(Generic[T]):
    """A callback that keeps its arguments, and can wait for a condition on them."""

    def __init__(self) -> None:
        self._items: list[T] = []
        self._condition = threading.Condition()

    def __call__(self, item: T) -> None:
        """Take an item."""
        with self._condition:
            self._items.append(item)
            self._condition.notify_all()

    @property
    def items(self) -> list[T]:
        """All items so far."""
        with self._condition:
            return list(self._items)

    def wait(self, condition: Callable[[list[T]], bool], what: str, timeout: float = WAIT_S) -> list[T]:
        """Wait until `condition(items)` is true; return the items."""
        with self._condition:
            assert self._condition.wait_for(lambda: condition(self._items), timeout), (
                f"waited {timeout:g} s in vain for {what}; came: {self._items!r:.400}"
            )
            return list(self._items)
