"""The backup lines of OPERATIONS.md, as printed: back up a running service, then restore and go on elsewhere."""

import re
import subprocess
from pathlib import Path

from net import WAIT_S
from processes import GROUND, T0, Feed, Service, connected, environment, replay

from roughmap_client.session import ask
from roughmap_schemas import CheckpointEvent, encode_cloud

OPERATIONS = (Path(__file__).resolve().parents[2] / "OPERATIONS.md").read_text(encoding="utf-8")
(SECTION,) = re.findall(r"^### Without containers\n(.*?)^###", OPERATIONS, re.MULTILINE | re.DOTALL)
BACKUP, RESTORE = re.findall(r"^```sh\n(.*?)^```$", SECTION, re.MULTILINE | re.DOTALL)


def placed(number: int) -> bytes:
    return encode_cloud(GROUND + 0.2 * number, T0 + number, "map")


def shell(lines: str, folder: Path, home: Path) -> None:
    """Typed by the service's user in a folder."""
    environ = {**environment(), "HOME": str(home)}
    subprocess.run(["sh", "-e", "-c", lines], cwd=folder, env=environ, check=True, timeout=WAIT_S)


def hand_in(feed: Feed, number: int) -> int:
    """A cloud, until it is in the map; its input number."""
    receipt = feed.ingest("points", "r1", placed(number))
    feed.decided(receipt.input)
    return receipt.input


def test_a_backup_holds_all_that_was_acknowledged_before_it(tmp_path: Path) -> None:
    here, there, home = (tmp_path / name for name in ("here", "there", "home"))
    patient = {"log": {"checkpoint_interval": 0.1}, "input": {"max_wait": 600.0}}
    with Service(here, store={"path": str(here / "map.db")}, **patient) as service, connected(service) as feed:
        home.mkdir()
        numbers = [hand_in(feed, number) for number in range(3)]
        ask(feed.session, "maps/site/control/snapshot", timeout=WAIT_S).single()
        numbers += [hand_in(feed, number) for number in range(3, 6)]  # behind the store's cut
        feed.events.wait(
            lambda events: any(isinstance(e, CheckpointEvent) and e.sequence == 6 for e in events), "a checkpoint"
        )
        digests = {tile.key: tile.info.digest for tile in feed.client.tiles()}
        waits = feed.ingest("points", "r2", encode_cloud(GROUND, T0 + 10**9, "lidar")).input  # acknowledged, undecided
        shell(BACKUP, here, home)
        hand_in(feed, 6)
        assert service.stop() == 0
    copies = [path for path in (home / "backup").rglob("*") if path.is_file()]
    assert {path.suffix for path in copies} == {".db", ".mcap"}
    assert not [path for path in copies if path.stat().st_mode & 0o007], "closed to others, as what they are copies of"
    code, verdict = replay(home / "backup" / "log")
    assert (code, ", sequence 6, digest " in verdict) == (0, True), verdict

    there.mkdir()
    shell(RESTORE, there, home)
    with Service(there, store={"path": str(there / "map.db")}, **patient) as service, connected(service) as feed:
        assert {tile.key: tile.info.digest for tile in feed.client.tiles()} == digests
        assert feed.client.status().clouds.waiting == 1
        again = [feed.ingest("points", "r1", placed(number)) for number in range(6)]
        assert [(receipt.input, receipt.duplicate) for receipt in again] == [(number, True) for number in numbers]
        assert feed.ingest("points", "r2", encode_cloud(GROUND, T0 + 10**9, "lidar")).input == waits
        assert not feed.ingest("points", "r1", placed(6)).duplicate, "it came after the backup"
        assert service.stop() == 0
    assert replay(there / "log")[0] == 0
