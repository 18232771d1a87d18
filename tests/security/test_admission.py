"""Who gets in at all: certificates of another authority, expired ones, none, wrong passwords, false routers, gossip."""

import json
import re
import runpy
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from access import (
    DOCKER,
    PASSWORDS,
    Certificates,
    example,
    make_certificates,
    open_router,
    put_settings,
    role_config,
    running_system,
    service_settings,
)
from net import WAIT_S, Gathered, locators, wait_until
from processes import Service

from roughmap_client import NoAnswer, RoughMapClient
from roughmap_service.cli.main import run


@pytest.fixture(scope="module")
def router(certificates: Certificates) -> Iterator[str]:
    with open_router(certificates.good) as endpoint:
        yield endpoint


@pytest.fixture(scope="module")
def password_router(certificates: Certificates) -> Iterator[str]:
    with open_router(certificates.good, passwords=True) as endpoint:
        yield endpoint


def refused(config: zenoh.Config) -> bool:
    """Whether there is no session to be had: one attempt, which ends by itself."""
    try:
        zenoh.open(config).close()
    except zenoh.ZError:
        return True
    return False


def trusting(config: zenoh.Config, authority: Path) -> zenoh.Config:
    return put_settings(config, transport__link__tls__root_ca_certificate=str(authority / "authority.pem"))


@pytest.mark.parametrize("role", ["rover1", "planner", "operator"])
def test_certificates_that_get_in_nowhere(router: str, certificates: Certificates, role: str) -> None:
    good, other = certificates.good, certificates.other
    assert not refused(role_config(role, router, good))
    assert refused(trusting(role_config(role, router, other), good)), "another authority's"
    assert refused(role_config(role, router, certificates.expired)), "expired"
    none = {"transport__link__tls__connect_certificate": None, "transport__link__tls__connect_private_key": None}
    assert refused(put_settings(role_config(role, router, good), **none, transport__link__tls__enable_mtls=False))
    assert refused(put_settings(role_config(role, router, good), connect__endpoints=[router.replace("tls/", "tcp/")]))
    name = {"transport__auth__usrpwd__user": "operator", "transport__auth__usrpwd__password": "guess"}
    assert refused(put_settings(role_config(role, router, good), **name)), "a name that the router can't check"
    foreign_key = {"transport__link__tls__connect_private_key": str(other / f"{role}.key")}
    assert refused(put_settings(role_config(role, router, good), **foreign_key)), "a certificate without its key"


def as_service(folder: Path) -> dict[str, Any]:
    return {
        "transport__link__tls__connect_certificate": str(folder / "service.pem"),
        "transport__link__tls__connect_private_key": str(folder / "service.key"),
    }


def test_passwords_that_get_in_nowhere(password_router: str, certificates: Certificates) -> None:
    def config(user: str, password: str | None) -> zenoh.Config:
        opened = role_config("planner", password_router, certificates.good, password=password or "x")
        return put_settings(opened, transport__auth__usrpwd__user=user)

    assert not refused(config("planner", PASSWORDS["planner"]))
    assert refused(config("planner", PASSWORDS["operator"]))
    assert refused(config("planner", ""))
    assert refused(config("stranger", PASSWORDS["planner"]))
    nameless = {"transport__auth__usrpwd__user": None, "transport__auth__usrpwd__password": None}
    assert refused(put_settings(config("planner", "x"), **nameless)), "without a name"


def test_nobody_can_pose_as_the_router(router: str, certificates: Certificates, tmp_path: Path) -> None:
    """A client tells a false router: by its authority, its time, its purpose, its name."""
    impostors = {
        "another authority's": (certificates.other, "router"),
        "expired": (certificates.expired, "router"),
        "a robot's": (certificates.good, "rover1"),
    }
    for what, (folder, name) in impostors.items():
        text = (
            example("router.json5", folder)
            .replace("/router.pem", f"/{name}.pem")
            .replace("/router.key", f"/{name}.key")
        )
        config = trusting(zenoh.Config.from_json5(text), certificates.good)
        put_settings(config, listen__endpoints=["tls/127.0.0.1:0"], adminspace__enabled=True, mode="peer")
        with zenoh.open(config) as impostor:
            (endpoint,) = locators(impostor)
            assert refused(role_config("planner", endpoint, certificates.good)), what
    by_name = router.replace("127.0.0.1", "127.0.0.2")  # loopback too, but not in the certificate
    assert refused(role_config("planner", by_name, certificates.good))
    assert not refused(role_config("planner", router, certificates.good))


def without_roles(certificates: Path) -> dict[str, Any]:
    """The four lines of SECURITY.md, no router."""
    files = {"authority": "authority.pem", "certificate": "service.pem", "private_key": "service.key"}
    return {"listen": ["tls/127.0.0.1:0"], **{name: str(certificates / file) for name, file in files.items()}}


def test_the_service_itself_lets_in_nobody_without_a_certificate(certificates: Certificates, tmp_path: Path) -> None:
    """Who has a certificate of the authority gets in, and nobody else."""
    with Service(tmp_path, zenoh=without_roles(certificates.good)) as service:
        (endpoint,) = service.ready()["endpoints"]
        with RoughMapClient(
            "site", config=role_config("planner", endpoint, certificates.good), timeout=WAIT_S
        ) as client:
            assert client.status().map == "site"
        assert refused(role_config("planner", endpoint, certificates.expired))
        assert refused(trusting(role_config("planner", endpoint, certificates.other), certificates.good))
        with pytest.raises(NoAnswer, match="no connection to tls/127"):
            RoughMapClient("site", endpoint, timeout=0.5)
        assert service.stop() == 0
        assert not [line for line in service.err if "insecure" in line]


def test_a_service_with_bad_certificates_starts_nowhere(
    router: str, certificates: Certificates, tmp_path: Path
) -> None:
    for name, folder in (("expired", certificates.expired), ("other", certificates.other)):
        settings = service_settings(router, folder)
        settings["zenoh"]["authority"] = str(certificates.good / "authority.pem")
        with Service(tmp_path / name, **settings) as service:
            assert service.finished(60) == 1
            assert f"can't open zenoh on {router} " in service.err[-1]
            assert "does it accept the certificate" in service.err[-1]


def test_a_robot_that_gossips_is_not_followed_around_the_router(certificates: Certificates, tmp_path: Path) -> None:
    """A peer with a robot's certificate that offers a link of its own: the service doesn't take it, a peer would."""
    with running_system(tmp_path, certificates.good, "certificates") as system:
        peer: dict[str, Any] = {"mode": "peer", "listen__endpoints": ["tcp/127.0.0.1:0"]}
        rogue_config = put_settings(role_config("rover1", system.endpoint, certificates.good), **peer)
        naive_config = put_settings(
            role_config("planner", system.endpoint, certificates.good), **peer, **as_service(certificates.good)
        )
        heard: Gathered[str] = Gathered()
        linked: Gathered[bool] = Gathered()
        with zenoh.open(naive_config) as naive, zenoh.open(rogue_config) as rogue:
            naive.declare_subscriber("robots/*/odometry", lambda sample: heard(str(sample.key_expr)))
            publisher = rogue.declare_publisher("robots/rover2/odometry")
            publisher.declare_matching_listener(lambda status: linked(status.matching))
            before = system.settled()
            if not publisher.matching_status.matching:
                linked.wait(lambda items: True in items, "the peers to find each other")
            publisher.put(system.pose())
            heard.wait(lambda items: items == ["robots/rover2/odometry"], "the forged pose at a peer that is naive")
            system.fence("rover1")
            assert system.settled().input == before.input


def make_short(folder: Path, certificates: Certificates) -> None:
    """Certificates of the good authority that end in 5 s."""
    for name in ("authority.pem", "authority.key"):
        shutil.copy(certificates.good / name, folder / name)
    runpy.run_path(str(DOCKER / "certificates.py"))["make"](folder, [], [], days=5 / 86400)


def unanswered(client: RoughMapClient) -> bool:
    try:
        client.status(timeout=3.0)
    except NoAnswer:
        return True
    return False


def test_a_link_to_the_service_itself_ends_with_its_certificate(certificates: Certificates, tmp_path: Path) -> None:
    with Service(tmp_path, zenoh=without_roles(certificates.good)) as service:
        (endpoint,) = service.ready()["endpoints"]
        make_short(tmp_path, certificates)
        config = put_settings(role_config("planner", endpoint, certificates.good), **as_service(tmp_path))
        with RoughMapClient("site", config=config, timeout=WAIT_S) as client:
            assert client.status().map == "site"
            wait_until(lambda: unanswered(client), "the link to end")
        assert service.stop() == 0


def test_a_link_ends_with_its_certificate(router: str, certificates: Certificates, tmp_path: Path) -> None:
    """And isn't made again: a session that came in while it was valid is out for good."""
    make_short(tmp_path, certificates)
    token = "maps/site/alive/short"
    seen: Gathered[zenoh.SampleKind] = Gathered()
    with (
        zenoh.open(role_config("planner", router, certificates.good)) as planner,
        zenoh.open(put_settings(role_config("planner", router, certificates.good), **as_service(tmp_path))) as short,
    ):
        planner.liveliness().declare_subscriber(token, lambda sample: seen(sample.kind))
        assert not list(planner.liveliness().get(token, timeout=WAIT_S))  # the router's answer: it has the subscriber
        short.liveliness().declare_token(token)
        seen.wait(lambda kinds: kinds[:2] == [zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE], "the link to end")
        # Certificates count in whole seconds: for the rest of its last one it may still get in.
        wait_until(
            lambda: refused(put_settings(role_config("planner", router, certificates.good), **as_service(tmp_path))),
            "a new session to be refused",
        )
        seen.wait(lambda kinds: kinds[-1] == zenoh.SampleKind.DELETE, "the end of what came back in that second")


def test_commands_with_a_zenoh_file(
    certificates: Certificates, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """simulate as a robot and query as a planner, through the router, with the examples' files; query is no robot."""
    with running_system(tmp_path / "map", certificates.good, "certificates") as system:
        for name in ("scanner", "planner"):
            (tmp_path / f"{name}.json5").write_text(
                re.sub(r"tls/127\.0\.0\.1:7447", system.endpoint, example(f"{name}.json5", certificates.good))
            )
        drive = ["simulate", "--duration", "1", "--rate", "0", "--rings", "8", "--columns", "64", "--json"]
        assert run([*drive, "--zenoh", str(tmp_path / "scanner.json5")]) == 0
        published = json.loads(capsys.readouterr().out)
        assert published["clouds"] > 0
        assert system.settled().input >= published["clouds"]
        ask = ["query", "--bbox", "-5,-5,5,5", "--json", "--zenoh", str(tmp_path / "planner.json5")]
        assert run(ask) == 0
        assert json.loads(capsys.readouterr().out)["map"] == "site"
        assert run([*drive, "--zenoh", str(tmp_path / "planner.json5"), "--wait", "1"]) == 1
        assert "nobody subscribes" in capsys.readouterr().err
        # And with the service's own settings and certificate, over the router that it joins.
        assert run(["query", "-c", str(tmp_path / "map" / "roughmap.toml"), *ask[1:4]]) == 0


def test_making_certificates_again_keeps_what_is_there(tmp_path: Path) -> None:
    made = {path.name: path.read_bytes() for path in make_certificates(tmp_path).iterdir()}
    make_certificates(tmp_path, "--robot", "rover3")
    assert {name: (tmp_path / name).read_bytes() for name in made} == made
    assert {path.name for path in tmp_path.iterdir()} - made.keys() == {"rover3.key", "rover3.pem"}
    assert all(path.stat().st_mode & 0o077 == 0 for path in tmp_path.glob("*.key"))
