"""The examples of docker/ at work: certificates, a router with its rules, a service, a session of each role."""

import json
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from net import WAIT_S
from processes import T0, Service

from roughmap_client import RoughMapClient
from roughmap_schemas import MapStatus, encode_cloud, encode_odometry

DOCKER = Path(__file__).parents[2] / "docker"
ROLES = ("rover1", "rover2", "planner", "operator")
EXAMPLE = {"rover1": "scanner", "rover2": "scanner", "planner": "planner", "operator": "operator"}
PASSWORDS = {name: f"secret of {name}" for name in ("service", *ROLES)}


def make_certificates(folder: Path, *options: str) -> Path:
    """Run the program as a user does."""
    command = [sys.executable, str(DOCKER / "certificates.py"), str(folder), *options]
    subprocess.run(
        [*command, "--robot", "rover1", "--robot", "rover2"], check=True, timeout=WAIT_S, capture_output=True
    )
    return folder


@dataclass(frozen=True)
class Certificates:
    """Folders of certificates: good ones, expired ones of the same authority, and ones of another authority."""

    good: Path
    expired: Path
    other: Path


def all_certificates(folder: Path) -> Certificates:
    """Make the three of them."""
    good, other = make_certificates(folder / "good"), make_certificates(folder / "other")
    (folder / "expired").mkdir()
    for name in ("authority.pem", "authority.key"):
        shutil.copy(good / name, folder / "expired" / name)
    expired = make_certificates(folder / "expired", "--expired")
    (good / "users.txt").write_text("".join(f"{name}:{password}\n" for name, password in PASSWORDS.items()))
    return Certificates(good, expired, other)


def example(name: str, certificates: Path) -> str:
    """The text of an example in docker/access, its files looked for in that folder."""
    text = (DOCKER / "access" / name).read_text()
    assert '"certificates/' in text
    return text.replace('"certificates/', f'"{certificates}/')


def put_settings(config: zenoh.Config, **settings: Any) -> zenoh.Config:
    """Settings put into a configuration, with `__` for `/`."""
    for path, value in settings.items():
        config.insert_json5(path.replace("__", "/"), json.dumps(value))
    return config


@contextmanager
def open_router(certificates: Path, *, passwords: bool = False, config: zenoh.Config | None = None) -> Iterator[str]:
    """The router of the example, or one of another configuration, on a free port of loopback; its endpoint."""
    chosen = config or zenoh.Config.from_json5(example("router.json5", certificates))
    put_settings(
        chosen, listen__endpoints=["tls/127.0.0.1:0"], adminspace__enabled=True,
        adminspace__permissions={"read": True, "write": False}, **(by_password(certificates) if passwords else {}),
    )  # fmt: skip
    with zenoh.open(chosen) as router:
        for reply in router.get(f"@/{router.zid()}/router", timeout=WAIT_S):
            if reply.ok is not None:
                yield json.loads(reply.ok.payload.to_bytes())["locators"][0]
                return
        raise AssertionError("the router's admin space did not answer")


def by_password(certificates: Path) -> dict[str, Any]:
    """What makes the router of the example ask for passwords in place of certificates."""
    return {
        "transport__link__tls__enable_mtls": False,
        "transport__auth__usrpwd__dictionary_file": str(certificates / "users.txt"),
    }


def role_config(role: str, endpoint: str, certificates: Path, *, password: str | None = None) -> zenoh.Config:
    """The example of a role, with that robot's certificate, or with a password in its place."""
    text = example(f"{EXAMPLE[role]}.json5", certificates).replace("/rover1.", f"/{role}.")
    config = put_settings(zenoh.Config.from_json5(text), connect__endpoints=[endpoint], connect__timeout_ms=0)
    if password is not None:
        put_settings(
            config, transport__link__tls__enable_mtls=False, transport__link__tls__connect_certificate=None,
            transport__link__tls__connect_private_key=None, transport__auth__usrpwd__user=role,
            transport__auth__usrpwd__password=password,
        )  # fmt: skip
    return config


def service_settings(endpoint: str, certificates: Path, *, passwords: bool = False) -> dict[str, Any]:
    """The sections of service.toml, for that router."""
    sections = tomllib.loads(example("service.toml", certificates))
    sections["zenoh"]["connect"] = [endpoint]
    if passwords:
        (certificates / "service.password").write_text(PASSWORDS["service"] + "\n")
        del sections["zenoh"]["certificate"], sections["zenoh"]["private_key"]
        sections["zenoh"] |= {"user": "service", "password_file": str(certificates / "service.password")}
    return sections


@dataclass
class System:
    """A service that is up behind its access control, and a session of each role."""

    service: Service
    sessions: dict[str, zenoh.Session]
    endpoint: str
    another: Callable[[str], zenoh.Session]
    """Opens one more session of a role."""
    stamp_ns: int = T0
    clients: dict[str, RoughMapClient] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.clients = {
            role: RoughMapClient("site", session=session, timeout=WAIT_S) for role, session in self.sessions.items()
        }
        self.known = {robot: self.pose() for robot in ("rover1", "rover2")}
        for robot in self.known:
            self.fence(robot)  # from now on these are duplicates, and change nothing

    def pose(self) -> bytes:
        """A pose that was never sent before."""
        self.stamp_ns += 10**7
        return encode_odometry(self.stamp_ns, "map", (0, 0, 0), (0, 0, 0, 1))

    def cloud(self) -> bytes:
        """A cloud that was never sent before, in the map's frame, so that it waits for nothing."""
        self.stamp_ns += 10**7
        return encode_cloud(np.array([[1.0, 1.0, 0.5]]), self.stamp_ns, "map")

    def fence(self, role: str) -> None:
        """Wait until all that a role sent before has passed the access control, and what it was sent has come.

        Links keep the order: the answer to something allowed comes behind both.
        """
        if role in self.known:
            self.clients[role].ingest(self.known[role], role, kind="odometry")
        else:
            self.clients[role].status()

    def settled(self) -> MapStatus:
        """The status once the service has taken up all that it was sent."""
        self.fence("rover1")
        return self.clients["operator"].status()


@contextmanager
def running_system(directory: Path, certificates: Path, how: str) -> Iterator[System]:
    """A service behind a router with `certificates` or `passwords`, or (`own`) one that is the router itself."""
    passwords = how == "passwords"
    with ExitStack() as stack:
        if how == "own":
            file = directory / "router.json5"
            file.write_text(example("router.json5", certificates))
            settings: dict[str, Any] = {"zenoh": {"config_file": str(file), "listen": ["tls/127.0.0.1:0"]}}
        else:
            settings = service_settings(
                stack.enter_context(open_router(certificates, passwords=passwords)), certificates, passwords=passwords
            )
        store = {"path": str(directory / "map.db")}
        service = stack.enter_context(Service(directory, **settings, store=store))
        endpoint = [*service.ready()["endpoints"], *settings["zenoh"].get("connect", [])][0]

        def opened(role: str) -> zenoh.Session:
            password = PASSWORDS[role] if passwords else None
            return zenoh.open(role_config(role, endpoint, certificates, password=password))

        yield System(service, {role: stack.enter_context(opened(role)) for role in ROLES}, endpoint, opened)
        assert service.stop() == 0, service.err
