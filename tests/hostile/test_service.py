"""A real service under attack: after each try it answers, has not grown, has counted what it refused by
the right reason, and takes another robot's cloud."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from net import WAIT_S
from processes import GROUND, T0, Feed, Service, running

from roughmap_client.session import ask
from roughmap_schemas import MapStatus, QueryError, encode_cloud, encode_odometry
from roughmap_schemas.wire import write_varint

MIB = 1 << 20
S = 10**9
MAX_TILES = 6000

GROWTH = 400 * MIB
"""What the whole file of tests may add to the process: 64 MiB of tiles, the room to work on a million points at once
(about 130 MB, kept), clouds of 24 MB on their way (Zenoh's, ours, the log's), and what the allocator keeps. What any of
the tries would take if it were not bounded is gigabytes."""

_times = count(1)


@dataclass
class Target:
    """The service under attack, and what it was before."""

    service: Service
    feed: Feed
    resident: int

    def memory(self) -> int:
        pages = int(Path(f"/proc/{self.service.process.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")

    @contextmanager
    def survives(self, **refused: int) -> Iterator[None]:
        """What is tried in here adds these counts to ``refused`` and no other; then all goes on."""
        before = self.feed.settle()
        yield
        after = self.feed.settle()
        for reason in {*before.refused, *after.refused, *refused} - {"duplicate"}:
            added = after.refused.get(reason, 0) - before.refused.get(reason, 0)  # type: ignore[call-overload]
            assert added == refused.get(reason, 0), f"{reason}: {added}"
        self.goes_on()

    def goes_on(self) -> MapStatus:
        turn = next(_times)
        points = np.repeat(GROUND + 0.001 * turn, 2, axis=0)  # one return alone is not yet ground
        event = self.feed.decided(self.feed.cloud("other", T0 + turn * S, points, "map"))
        assert event.accepted == len(points)
        region = self.feed.client.region((0.0, -1.0, 3.0, 1.0), ["mean_height"])
        assert np.isfinite(region["mean_height"]).any()
        status = self.feed.settle()
        assert status.health == "ok"
        assert self.memory() - self.resident < GROWTH, f"{(self.memory() - self.resident) / MIB:.0f} MiB more"
        assert self.service.process.poll() is None
        return status

    def errors(self, selector: str, payload: bytes | None = None) -> list[str]:
        answer = ask(self.feed.session, selector, timeout=WAIT_S, payload=payload)
        assert not answer.parts
        return [QueryError.model_validate_json(error).code for error, _ in answer.errors]


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Target]:
    """All of the file try the same one; at the end it must stop in order, and replay as equal."""
    settings = {"map": {"memory_limit": 64 * MIB, "max_tiles": MAX_TILES}, "input": {"max_wait": 0.3}}
    with running(tmp_path_factory.mktemp("hostile"), **settings) as (service, feed):
        it = Target(service, feed, 0)
        it.resident = it.memory()
        it.goes_on()
        yield it


def placed(target: Target, points: np.ndarray) -> tuple[str, int, dict[str, int]]:
    """Outcome, accepted and rejected points of a cloud in the map's frame."""
    stamp = T0 + next(_times) * S
    event = target.feed.decided(target.feed.cloud("bad", stamp, points, "map"))
    return str(event.outcome), event.accepted, {str(reason): n for reason, n in event.rejected.items()}


def test_a_million_points_on_one_spot(target: Target) -> None:
    with target.survives():
        points = np.full((1_000_000, 3), [50.05, 50.05, 1.0])
        assert placed(target, points) == ("integrated", 1_000_000, {})
    cell = target.feed.client.cells([(50.05, 50.05)], ["mean_height", "std_dev"])
    assert (cell.states[0].count, cell["mean_height"][0], cell["std_dev"][0]) == (1_000_000, 1.0, 0.0)  # type: ignore[union-attr]


def tiles_of(status: MapStatus) -> int:
    return status.tiles.resident + status.tiles.spilled


@pytest.mark.parametrize("far", [1e300, -1e300, 1.7e308, 2.2e8], ids=str)
def test_points_beyond_all_maps(target: Target, far: float) -> None:
    with target.survives():
        outcome, accepted, rejected = placed(target, np.array([[far, 0.0, 0.0], [0.0, far, 0.0], [far, far, far]]))
        assert (outcome, accepted) == ("empty", 0)
        assert sum(rejected.values()) == 3
        assert set(rejected) <= {"bounds", "uncertain", "not_finite"}


def test_heights_beyond_all_measure(target: Target) -> None:
    """Ground is within 10,000 km; all that is off it may come at once."""
    spot, layers = [-50.05, 50.05], ["mean_height", "std_dev", "slope", "traversability"]
    with target.survives():
        for far in (1e300, 1e149, 1.1e7):
            outside = placed(target, np.array([[*spot, far], [*spot, -far]]))
            assert outside == ("empty", 0, {"bounds": 2})
        inside = np.array([[*spot, z] for z in (9.9e6, -9.9e6, 0.0, 0.0)])
        assert placed(target, inside) == ("integrated", 4, {})
        target.feed.client.region((-51.0, 49.0, -49.0, 51.0), layers)


def test_heights_beyond_all_measure_in_a_map_of_all_points(tmp_path: Path) -> None:
    """A height whose square is no number is out of bounds; half as many digits spoil their cell alone."""
    with running(tmp_path, map={"surface": "all"}) as (service, feed):
        target = Target(service, feed, 0)
        target.resident = target.memory()
        assert placed(target, np.array([[-50.05, 50.05, 1e300], [-50.05, 50.05, -1e300]]))[:2] == ("empty", 0)
        assert placed(target, np.array([[-50.05, 50.05, 1e149], [-50.05, 50.05, -1e149]]))[1] == 2
        feed.client.region((-51.0, 49.0, -49.0, 51.0), ["mean_height", "std_dev", "slope", "traversability"])
        target.goes_on()


def test_a_point_a_tile_over_a_million_tiles(target: Target) -> None:
    i, j = np.divmod(np.arange(1_000_000), 1000)
    with target.survives():
        before = target.feed.settle()
        assert (
            placed(target, np.column_stack((i * 6.4 + 3.2, j * 6.4 + 3.2, np.zeros(1_000_000))))[0] == "too_many_tiles"
        )
        after = target.feed.settle()
        assert after.clouds.rejected["too_many_tiles"] == before.clouds.rejected.get("too_many_tiles", 0) + 1  # type: ignore[index, call-overload]
        assert tiles_of(after) == tiles_of(before)


def test_no_more_tiles_than_the_map_may_have(target: Target) -> None:
    """Each cloud within max_new_tiles: beyond max_tiles new ground is refused, known ground is taken."""
    outcomes = []
    with target.survives():
        for strip in range(4):
            i, j = np.divmod(np.arange(2500), 50)
            points = np.column_stack((i * 6.4 + 3203.2, (j + 50 * strip) * 6.4 + 3203.2, np.zeros(2500)))
            outcomes.append(placed(target, points)[0])
    assert outcomes == ["integrated", "integrated", "too_many_tiles", "too_many_tiles"]
    assert 5000 < tiles_of(target.feed.settle()) <= MAX_TILES


def test_queries_for_everything_in_odd_words(target: Target) -> None:
    with target.survives():
        many = "/".join(["*"] * 1000)
        assert target.errors(f"maps/site/tiles/{many}") == []  # no such keys: nobody is asked
        assert target.errors("maps/site/" + "**/a/" * 500 + "x") == []
        assert target.errors("maps/site/tiles/0/" + "$*1" * 500 + "/*") == []  # a pattern that no number has
        for key in ("-0/*/*", "0/99999999999/*", "0/" + "9" * 60_000 + "/*"):
            assert target.errors(f"maps/site/tiles/{key}") == ["bad_key"]
        assert target.errors("maps/site/tiles/0/*/*?layers=" + ",".join(["*"] * 1000)) == ["unknown_layer"]
        assert target.errors("maps/site/tiles/0/*/*?" + ";".join(f"a{n}=*" for n in range(1000))) == [
            "unknown_parameter"
        ]
        assert target.errors("maps/site/tiles/0/*/*?bbox=" + ",".join(["*"] * 1000)) == ["bad_bbox"]
        assert target.errors("maps/site/tiles/0/*/*?layers=" + "x" * 65536) == ["too_large"]
        assert target.errors("maps/site/region?bbox=-1e308,-1e308,1e308,1e308") == ["too_large"]
        assert target.errors("maps/site/tiles/0/*/*?layers=range;bbox=-1e9,-1e9,1e9,1e9") == ["too_large"]


def test_requests_for_cells(target: Target) -> None:
    with target.survives():
        cells = "maps/site/cells"
        place = b"[0.05,0.05]"
        assert target.errors(cells, b"[" + b",".join([place] * 10_001) + b"]") == ["too_large"]
        assert target.errors(cells, b" " * (MIB + 1)) == ["too_large"]
        for payload in (
            b"[" * 500_000,
            b'{"a":' * 100_000,
            b"[[" + b"9" * 500_000 + b",0]]",
            b"\xff" * 1000,
            b"[[NaN,0]]",
        ):
            assert target.errors(cells, payload) == ["bad_parameter"]
        assert len(target.feed.client.cells([(0.05, 0.05)] * 10_000, ["mean_height"])) == 1


def test_keys_as_long_as_they_may_be(target: Target) -> None:
    pose = encode_odometry(T0, "map", (0, 0, 0), (0, 0, 0, 1))
    with target.survives(bad_key=3):
        target.feed.put("odometry", "r" * 60_000, pose)
        target.feed.put("odometry", "\N{SNOWMAN}" * 5_000, pose)
        assert target.feed.refused("odometry", "r" * 60_000, pose) == "bad_key"


def test_attachments_of_any_size(target: Target) -> None:
    """Only eight bytes are a number; one that leaps beyond all measure is no gap."""
    with target.survives():
        before = target.feed.settle()
        for number, size in enumerate([0, 1, 7, 9, 64, MIB]):
            pose = encode_odometry(T0 + number * S // 10, "map", (0, 0, 0), (0, 0, 0, 1))
            target.feed.put("odometry", "bad", pose, attachment=b"\xff" * size)
        middle = target.feed.settle()
        assert middle.poses.accepted == before.poses.accepted + 6
        assert middle.gaps == before.gaps
        for number, told in enumerate([0, 2**64 - 1, 5, 2**63, *range(6, 14)]):
            pose = encode_odometry(T0 + (6 + number) * S // 10, "map", (0, 0, 0), (0, 0, 0, 1))
            target.feed.put("odometry", "bad", pose, attachment=told.to_bytes(8, "little"))
        after = target.feed.settle()
        assert after.gaps == {**before.gaps, "bad": 4}


def test_messages_that_claim_to_be_huge(target: Target) -> None:
    with target.survives(bad_message=6):
        for size in (2**20, 2**31, 2**63):
            payload = b"\x2a" + write_varint(size) + b"abc"
            target.feed.put("points", "bad", payload)
            assert target.feed.refused("points", "bad", payload) == "bad_message"
    with target.survives(too_large=1):
        target.feed.put("odometry", "bad", b"\x78\x01" * 100_000)  # entries of a field that the schema doesn't have


def test_a_flood_of_robots(target: Target) -> None:
    """Names that nobody configured: so many are heard, the rest are refused, and those heard go on."""
    names = 1000
    before = target.feed.settle()
    for number in range(names):
        pose = encode_odometry(T0, "map", (0, 0, number), (0, 0, 0, 1))
        target.feed.put("odometry", f"flood-{number}", pose, attachment=(number * 1000).to_bytes(8, "little"))
    payload = encode_cloud(GROUND, T0, "map")
    assert target.feed.refused("points", "one-more", payload) == "unknown_robot"
    status = target.goes_on()
    refused = status.refused["unknown_robot"]  # type: ignore[index]
    assert status.poses.accepted - before.poses.accepted == names + 1 - refused
    assert 200 < names + 1 - refused <= 256
