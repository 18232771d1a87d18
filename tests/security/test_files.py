"""What the service writes is for its owner and group; nobody else can put something into its way."""

import stat
from pathlib import Path

import pytest
from processes import Service, connected, running

from roughmap_service.journal.repair import repair


def test_log_and_store_are_closed_to_others(tmp_path: Path) -> None:
    files = {"store": {"path": str(tmp_path / "state" / "map.db")}}
    with running(tmp_path / "service", **files) as (_, feed):
        feed.cloud("r1", 1_700_000_000 * 10**9, frame="map")
        feed.session.get("maps/site/control/snapshot")
        feed.settle()
    written = [*(tmp_path / "service" / "log").rglob("*"), *(tmp_path / "state").rglob("*"), tmp_path / "state"]
    assert {path.suffix for path in written} >= {".mcap", ".db", ".lock", ""}
    assert not [path for path in written if path.stat().st_mode & (stat.S_IRWXO | stat.S_IWGRP)]


def last_words(directory: Path, **settings: dict[str, str]) -> str:
    with Service(directory, **settings) as service:
        assert service.finished(60) in (1, 2)
        return service.err[-1]


def test_a_folder_that_everybody_writes_to_is_refused(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o1777)  # as /tmp is
    assert f"{shared}: every user of this machine may write there" in last_words(
        tmp_path / "a", log={"directory": str(shared)}
    )
    assert f"{shared}: every user" in last_words(tmp_path / "b", store={"path": str(shared / "map.db")})
    with Service(tmp_path / "c", log={"directory": str(shared / "own")}) as service, connected(service):
        assert service.stop() == 0


def test_a_link_in_the_way_of_the_lock_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "log").mkdir()
    (tmp_path / "log" / ".lock").symlink_to(tmp_path / "made")
    assert str(tmp_path / "log" / ".lock") in last_words(tmp_path)
    assert not (tmp_path / "made").exists()


def test_a_link_in_the_place_of_the_store_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "map.db").symlink_to(tmp_path / "made")
    told = last_words(tmp_path, store={"path": str(tmp_path / "map.db")})
    assert f"store.path: {tmp_path / 'map.db'} is a link" in told
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("suffix", [".part", ".rest", ".torn"])
def test_a_link_in_the_way_of_a_repair_is_not_followed(tmp_path: Path, suffix: str) -> None:
    with Service(tmp_path) as service, connected(service) as feed:
        feed.cloud("r1", 1_700_000_000 * 10**9, frame="map")
        service.kill()
    (log,) = service.log.glob("*.mcap")
    with log.open("ab") as stream:
        stream.write(b"\x05torn")
    victim = tmp_path / "victim"
    victim.write_text("of somebody else")
    Path(f"{log}{suffix}").symlink_to(victim)
    torn = repair(log)
    assert torn == Path(f"{log}{'.torn.1' if suffix == '.torn' else '.torn'}")
    assert torn.read_bytes() == b"\x05torn"
    assert not torn.is_symlink()
    assert victim.read_text() == "of somebody else"
