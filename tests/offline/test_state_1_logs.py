"""Logs of state version 1, whose cells had no trust and no column: they are integrated again, and not compared.

The files in `state_1` are such a log, as `roughmap serve` of that version made it from 1.2 s of `roughmap simulate`,
and a map.db of `roughmap build`. That version said of the log what `THEN` holds.
"""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import xxhash
from log_edits import nth, rewrite
from replay_tools import refused, replay
from service_tools import config, events_of, read_back, starts_of

from roughmap import RoughMap
from roughmap_schemas import Config, IntegrationEvent
from roughmap_service.engine.recovery import OtherLogState, recover
from roughmap_service.run.settings import new_map
from roughmap_service.store.map_db import OtherStateVersion, Store

OLD = Path(__file__).with_name("state_1")
THEN = "equal: 4 checkpoints, sequence 12, digest ca899a0def9bd078f86bf0ed8a1f0fcc"


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    return Path(shutil.copytree(OLD, tmp_path / "log", ignore=shutil.ignore_patterns("map.db")))


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(Path(shutil.copy(OLD / "map.db", tmp_path / "map.db")))


def restored(path: Path) -> RoughMap:
    """The map of a store, whatever its settings."""
    store = Store(path)
    cut = store.read_cut()
    assert cut is not None
    rough_map = new_map(Config.from_log(cut.configuration))
    store.load_into(rough_map, cut)
    return rough_map


def digest_of_then(rough_map: RoughMap) -> str:
    """The digest of state version 1: over the cells alone."""
    with rough_map.freeze() as frozen:
        rows = b"".join(
            np.array((x, y), "<i4").tobytes() + xxhash.xxh3_128_digest(frozen.records(x, y).tobytes())
            for x, y in frozen.tiles.tolist()
        )
    return xxhash.xxh3_128_hexdigest(rows)


def test_it_is_of_a_version_without_a_surface(logs: Path) -> None:
    (start, *_) = starts_of(read_back(logs))
    assert "surface" not in start.metadata.configuration["map"]
    assert (start.metadata.state_version, start.config.map.surface) == (1, "all")


def test_it_is_integrated_and_not_compared(logs: Path, tmp_path: Path) -> None:
    """The cells come out as they were, which the digests of today can't say."""
    code, said, _ = replay(logs, "-o", tmp_path / "new.db")
    rough_map = restored(tmp_path / "new.db")
    expected = (
        "not comparable: the log's 4 digests are of state version 1, this release's of version 2; all 17 events "
        f"came out as logged; sequence 12, digest {rough_map.digest()}"
    )
    assert (code, said) == (3, expected)
    assert digest_of_then(rough_map) == THEN.rpartition(" ")[2]


def test_it_never_differs(logs: Path) -> None:
    """Not even where an event does: that is told."""

    def fewer(data: bytes) -> bytes:
        return re.sub(rb'"accepted":[0-9]+', b'"accepted":1', data)

    rewrite(min(logs.iterdir()), nth("/events", 2, fewer))
    code, said, _ = replay(logs, "--json")
    assert (code, json.loads(said)["equal"]) == (3, None)
    assert "; 1 of 17 events came out otherwise; " in json.loads(said)["verdict"]


def test_its_own_log_of_today_is_equal(logs: Path, tmp_path: Path) -> None:
    new = tmp_path / "new"
    assert replay(logs, "--log-out", new)[0] == 3
    assert {start.metadata.state_version for start in starts_of(read_back(new))} == {2}
    code, said, _ = replay(new)
    assert (code, said.startswith("equal: 4 checkpoints, sequence 12")) == (0, True)


@pytest.mark.parametrize("surface", ["all", "ground"])
def test_no_start_goes_on_from_it_but_the_command_that_it_names_makes_a_map(
    logs: Path, tmp_path: Path, surface: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (start, *_) = starts_of(read_back(logs))
    settings = start.config.model_dump(exclude={"map": {"limits"}})
    wanted = Config.model_validate({**settings, "map": {**settings["map"], "surface": surface}})
    with pytest.raises(OtherLogState) as caught:
        recover(wanted, logs, None)
    assert caught.value.exit_code == 2
    text = str(caught.value)
    assert text.startswith(f"{logs} is of state version 1")
    assert "--fresh" in text
    (command,) = re.findall("`roughmap replay (.*)`", text)
    monkeypatch.chdir(tmp_path)
    assert replay(*command.split())[0] == 3
    made = Store(tmp_path / "map-2.db")
    back = recover(wanted, tmp_path / "new", made)
    assert (back.run.map.sequence, back.run.map.settings.surface) == (12, surface)


def test_an_old_store_is_named_with_its_log(logs: Path, store: Store) -> None:
    with pytest.raises(OtherStateVersion, match="has state version 1, not 2"):
        store.read_cut()
    with pytest.raises(OtherLogState, match=rf"{logs} and {store.path} are of state version 1"):
        recover(config(), logs, store)
    assert store.exists(), "nothing was set aside"


def test_an_old_store_alone(store: Store, tmp_path: Path) -> None:
    with pytest.raises(
        Exception, match=r"has state version 1, not 2, and there is no log in .* to rebuild the map from"
    ) as caught:
        recover(config(), tmp_path / "new", store)
    assert caught.value.exit_code == 2


def test_what_is_left_out_of_an_old_log(logs: Path) -> None:
    refused(replay(*sorted(logs.glob("*.mcap"))[1:]), "not at the beginning of the run")


def test_events_without_what_was_cleared(logs: Path) -> None:
    assert {event.cleared for event in events_of(read_back(logs)) if isinstance(event, IntegrationEvent)} == {0}
