"""A service's life as a process: the ready line, the ways to end, and what keeps it from starting."""

import json
import re
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from net import Gathered, peer_config
from processes import Service, connected, replay

from roughmap_schemas import encode_cloud


def refused(directory: Path, *arguments: str, **settings: dict[str, object]) -> tuple[int, str]:
    """Exit code of a service that can't start, and the one line that it says."""
    with Service(directory, *arguments, **settings) as service:
        code = service.finished(60.0)
        assert service.out == [], "stdout is for the ready line alone"
        said = [line for line in service.err if line.startswith("roughmap: ")]
        assert len(said) == 1, service.err
        assert not any("Traceback" in line for line in service.err), service.err
        return code, said[0]


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with Service(tmp_path_factory.mktemp("life")) as service:
        service.ready()
        yield service


def test_the_ready_line(service: Service) -> None:
    line = service.ready()
    assert list(line) == ["ready", "map", "instance", "endpoints", "http"]
    assert line["ready"] is True
    assert line["map"] == "site"
    assert re.fullmatch("[0-9a-f]{32}", line["instance"])
    assert line["http"] is None
    (endpoint,) = line["endpoints"]
    assert re.fullmatch(r"tcp/127\.0\.0\.1:[1-9][0-9]*", endpoint), "the real port stands in place of 0"


def test_the_token_is_there_while_the_service_is(tmp_path: Path) -> None:
    with Service(tmp_path) as service:
        ready = service.ready()
        with zenoh.open(peer_config(connect=ready["endpoints"])) as session:
            seen: Gathered[tuple[str, zenoh.SampleKind]] = Gathered()
            session.liveliness().declare_subscriber(
                "maps/site/alive/*", lambda sample: seen((str(sample.key_expr), sample.kind)), history=True
            )
            key = f"maps/site/alive/{ready['instance']}"
            seen.wait(lambda items: (key, zenoh.SampleKind.PUT) in items, "the token")
            assert service.stop() == 0
            seen.wait(lambda items: (key, zenoh.SampleKind.DELETE) in items, "the token's end")
        assert service.out == [json.dumps(ready)], "nothing follows the ready line on stdout"
        code, verdict = replay(service.log)
        assert code == 0, "a map that stayed empty can be replayed too"
        assert verdict.startswith("equal: 1 checkpoints, sequence 0, digest ")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_in_order(tmp_path: Path, number: signal.Signals) -> None:
    with Service(tmp_path) as service, connected(service) as feed:
        receipt = feed.ingest("points", "r1", encode_cloud([[0.05, 0.05, 1.0]], 10**9, "map"))
        feed.decided(receipt.input)
        assert service.stop(number) == 0
        assert replay(service.log)[1].startswith("equal: 1 checkpoints, sequence 1, digest ")


def test_a_signal_is_heeded_from_the_first_line_on(tmp_path: Path) -> None:
    with Service(tmp_path) as service:
        service.line("roughmap")
        assert service.stop() == 0
        assert service.out == []
        assert "shut down in order on SIGTERM" in service.err[-1]


def test_a_second_service_of_the_same_map_does_not_start(service: Service, tmp_path: Path) -> None:
    ready = service.ready()
    with Service(tmp_path, zenoh={"connect": ready["endpoints"]}) as second:
        assert second.finished(60.0) == 2
        assert f"map 'site' is served already, by maps/site/alive/{ready['instance']}" in second.err[-1]
        (waiting,) = [line for line in second.err if "seems to be served already" in line]
        assert ready["instance"] in waiting
        assert "waiting up to 0.2 s (service.alive_wait) for it to end" in waiting, "said before, not only at the end"


def test_another_map_beside_it_does_start(service: Service, tmp_path: Path) -> None:
    """The same session space, another name: each answers for its own map."""
    endpoints = service.ready()["endpoints"]
    with Service(tmp_path, map={"name": "yard"}, zenoh={"connect": endpoints}) as yard:
        with connected(yard, "yard") as feed:
            assert feed.client.status().map == "yard"
        assert yard.stop() == 0


def test_a_log_directory_in_use(service: Service, tmp_path: Path) -> None:
    code, said = refused(tmp_path, map={"name": "other"}, log={"directory": str(service.log)})
    assert code == 2
    assert f"{service.log / '.lock'}: held by another service" in said


def test_a_store_in_use(tmp_path: Path) -> None:
    store = {"path": str(tmp_path / "map.db")}
    with Service(tmp_path / "first", store=store) as first:
        first.ready()
        code, said = refused(tmp_path / "second", map={"name": "other"}, store=store)
        assert code == 2
        assert "map.db.lock: held by another service" in said


def test_a_port_in_use(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        code, said = refused(tmp_path, zenoh={"listen": [endpoint]})
    assert code == 1
    assert endpoint in said
    assert "zenoh.listen" in said


@pytest.mark.parametrize("place", ["log", "store"])
def test_a_directory_that_cannot_be_written(tmp_path: Path, place: str) -> None:
    """Below a file no directory can be made, not even by root, whom permissions don't hold back."""
    (tmp_path / "file").write_text("")
    path = tmp_path / "file" / place
    settings = {"log": {"directory": str(path)}} if place == "log" else {"store": {"path": str(path / "map.db")}}
    code, said = refused(tmp_path, **settings)
    assert code == 2
    assert (
        f"{'log.directory' if place == 'log' else 'store.path'}: {path} can't be written: a file is in its way" in said
    )


def test_a_store_that_is_a_folder(tmp_path: Path) -> None:
    code, said = refused(tmp_path, store={"path": str(tmp_path)})
    assert (code, f"store.path: {tmp_path} is a folder; name a file" in said) == (2, True)


@pytest.mark.parametrize(
    ("settings", "said_parts"),
    [
        ({"map": {"cell_sise": 0.2}}, ["roughmap.toml", "map.cell_sise"]),
        ({"map": {"cell_size": -1.0}}, ["roughmap.toml", "map.cell_size"]),
        ({"map": {"error_model": "sphere"}}, ["roughmap.toml", "map.error_model", "ellipsoid"]),
        ({"sensors": {"lidar": {}}}, ["roughmap.toml", "sensors.lidar.range_sigma"]),
        ({"log": {"keep": "1GiB"}}, ["log.keep", "store"]),
    ],
)
def test_a_bad_configuration(tmp_path: Path, settings: dict[str, dict[str, object]], said_parts: list[str]) -> None:
    code, said = refused(tmp_path, **settings)
    assert code == 2
    for part in said_parts:
        assert part in said


def test_a_configuration_file_that_is_none(tmp_path: Path) -> None:
    (tmp_path / "broken.toml").write_text("[map\n")
    code, said = refused(tmp_path, "-c", str(tmp_path / "broken.toml"))
    assert code == 2
    assert "broken.toml" in said


def test_a_foreign_file_in_the_log_directory(tmp_path: Path) -> None:
    """It is no file of the run: the service leaves it as it is, and a replay of the folder names it."""
    (tmp_path / "log").mkdir()
    foreign = tmp_path / "log" / "holiday.mcap"
    content = b"no log at all, but a hundred and more bytes of something else " * 3
    foreign.write_bytes(content)
    with Service(tmp_path) as service:
        with connected(service) as feed:
            assert feed.client.status().sequence == 0
        assert service.stop() == 0
    assert foreign.read_bytes() == content
    assert not list(service.log.glob("*.torn"))
    code, said = replay(service.log)
    assert code == 2
    assert "holiday.mcap" in said
