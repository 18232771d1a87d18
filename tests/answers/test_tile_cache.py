"""What is kept of tiles between readers: within its limit, never another tile's nor another state's."""

from itertools import product

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from served import INSTANCE, RUN, T0, S, filled, some_points

from roughmap_schemas import Config, Keys, decode_grid
from roughmap_schemas.messages import TileInfo, model_bytes
from roughmap_service.answers.drawn_tile import DrawnTile
from roughmap_service.answers.emptied_tiles import EmptiedHistory
from roughmap_service.answers.map_reader import MapReader
from roughmap_service.answers.plan import Reply
from roughmap_service.answers.region import plan_region
from roughmap_service.answers.served_map import ServedMap
from roughmap_service.answers.tile_cache import ENTRY_BYTES, TileCache
from roughmap_service.answers.tiles import TileQueries
from roughmap_service.run.view import View

INFO = TileInfo(
    map="site", instance=INSTANCE, epoch=5, z=0, x=1, y=2, sequence=3, map_sequence=0, answer_tiles=0,
    oldest_ns=T0, newest_ns=T0, known_cells=0, digest="0" * 32, configuration_digest="0" * 32,
)  # fmt: skip
BLANK = np.zeros((64, 64, 1), np.float32)
BYTES = BLANK.nbytes


def drawn(info: TileInfo = INFO, values: np.ndarray = BLANK) -> DrawnTile:
    return DrawnTile(info, ["mean_height"], values, bytes(512), 0.1, "map")


def test_what_was_not_asked_for_the_longest_goes_first() -> None:
    cache = TileCache(3 * (BYTES + ENTRY_BYTES))
    made = []

    def ask(key: str) -> None:
        def draw() -> DrawnTile:
            made.append(key)
            return drawn()

        cache.get(key, draw)

    for key in "abcaabdadc":
        ask(key)
        assert cache.nbytes <= 3 * (BYTES + ENTRY_BYTES)
    assert "".join(made) == "abcdc"  # d came for c, then c for b


def test_a_tile_larger_than_the_limit_is_not_kept() -> None:
    cache = TileCache(1000)
    tile = drawn()
    assert cache.get("a", lambda: tile) is tile
    assert cache.nbytes == 0


def test_a_tile_is_kept_once() -> None:
    """Before its messages are made and after: the same values, in the payload then."""
    values = np.random.default_rng(1).normal(size=(64, 64, 1)).astype(np.float32)
    tile = drawn(values=values)
    assert tile.values is values
    layer = decode_grid(tile.payload).layers["mean_height"]
    assert layer.tobytes() == tile.values.tobytes() == values.tobytes()
    assert tile.payload is tile.payload
    assert tile.nbytes == BYTES
    assert np.shares_memory(tile.values, np.frombuffer(tile.payload, np.uint8))


def test_a_compressed_tile_is_kept_compressed() -> None:
    tile = drawn(INFO.model_copy(update={"compression": "zstd"}))
    assert tile.nbytes == len(tile.payload) < BYTES
    assert decode_grid(tile.payload, "zstd").layers["mean_height"].tobytes() == BLANK.tobytes()


NUMBERS = st.integers(0, 2**61)  # a stamp in ns is below 2^32 s
INFOS = st.builds(
    TileInfo, map=st.text(), instance=st.text(), epoch=NUMBERS, z=NUMBERS, x=st.none() | st.integers(),
    y=st.none() | st.integers(), sequence=NUMBERS, map_sequence=st.just(0), answer_tiles=st.just(0), oldest_ns=NUMBERS,
    newest_ns=NUMBERS, known_cells=NUMBERS, digest=st.none() | st.text(), configuration_digest=st.text(),
    compression=st.sampled_from([None, "zstd"]),
)  # fmt: skip


@given(INFOS, NUMBERS, NUMBERS)
def test_an_attachment_has_the_bytes_that_the_model_has(info: TileInfo, map_sequence: int, answer_tiles: int) -> None:
    tile = drawn(info)
    in_answer = TileInfo.model_validate(
        {**info.model_dump(), "map_sequence": map_sequence, "answer_tiles": answer_tiles}
    )
    assert tile.attachment(map_sequence, answer_tiles) == model_bytes(in_answer)
    assert tile.info_in_answer(map_sequence, answer_tiles) == in_answer


def replies(reader: MapReader, what: str, parameters: str) -> list[Reply]:
    plan = plan_region(reader, parameters) if what == "region" else TileQueries(reader).plan(what, parameters)
    with plan.read() as answer:
        return sorted(answer.replies)


def test_answers_follow_the_map() -> None:
    """A reader that keeps tiles says what one says that keeps none: after more points here, points far away, which age
    these, and a reset."""
    config = Config.model_validate({"map": {"name": "site"}})
    keeps_none = config.model_copy(update={"query": config.query.model_copy(update={"cache_limit": 1})})
    with filled(config) as rough_map:
        view, keys, resets = View(rough_map, 5), Keys("site", config.keys), EmptiedHistory(1000)
        served = ServedMap("site", RUN, INSTANCE, "0" * 32, "map", "all")
        kept, plain = (MapReader(view, keys, one, served, resets) for one in (config, keeps_none))
        for change in ("none", "points", "far", "reset", "points"):
            if change == "points":
                rough_map.add(some_points(300, 9), S, T0 + 20 * 10**9)
            elif change == "far":
                rough_map.add(some_points(300, 9, (200.0, 0.0)), S, T0 + 40 * 10**9)
            elif change == "reset":
                resets.note(rough_map.tile_sequences()[0], rough_map.sequence + 1)
                rough_map.reset()
                view.epoch += 1
            for what, layers, form in product(
                ("maps/site/tiles/0/*/*", "maps/site/tiles/1/*/*", "region"),
                ("mean_height,count", "count,mean_height", "traversability,confidence_level", "age"),
                ("", ";dtype=f8", ";compression=zstd", ";limits=slope:0.1", ";tolerance=0.2", ";since=1;epoch=5"),
            ):
                if what == "region" and "since" in form:
                    continue
                parameters = f"bbox=-3,-3,13,5;layers={layers}{form}"
                first, again = replies(kept, what, parameters), replies(kept, what, parameters)
                assert first == again == replies(plain, what, parameters), (change, what, parameters)
