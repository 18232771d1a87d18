"""What is kept of tiles between readers: within its limit, never another tile's nor another state's."""

from itertools import product

import numpy as np
from served import INSTANCE, RUN, T0, S, filled, some_points

from roughmap_schemas import Config, Keys
from roughmap_schemas.messages import TileInfo, parse_model
from roughmap_service.answers.emptied import Emptied
from roughmap_service.answers.tile_cache import ENTRY_BYTES, DrawnTile, TileCache, drawn_tile
from roughmap_service.answers.tile_reply import Identity
from roughmap_service.answers.tiles import Reader
from roughmap_service.run.view import View


def drawn(size: int) -> DrawnTile:
    info = TileInfo(
        map="site", instance=INSTANCE, epoch=5, z=0, x=1, y=2, sequence=3, map_sequence=0, answer_tiles=0,
        oldest_ns=T0, newest_ns=T0, known_cells=0, digest="0" * 32, configuration_digest="0" * 32,
    )  # fmt: skip
    return drawn_tile(bytes(size), info, np.zeros((64, 64), np.bool_))


def test_what_was_not_asked_for_the_longest_goes_first() -> None:
    cache = TileCache(3 * (1000 + ENTRY_BYTES))
    made = []

    def ask(key: str) -> None:
        def draw() -> DrawnTile:
            made.append(key)
            return drawn(1000)

        cache.get(key, draw)

    for key in "abcaabdadc":
        ask(key)
        assert cache.nbytes <= 3 * (1000 + ENTRY_BYTES)
    assert "".join(made) == "abcdc"  # d came for c, then c for b


def test_a_tile_larger_than_the_limit_is_not_kept() -> None:
    cache = TileCache(1000)
    assert cache.get("a", lambda: drawn(2000)).payload == bytes(2000)
    assert cache.nbytes == 0


def test_what_is_told_of_a_tile_is_what_the_model_says() -> None:
    tile = drawn(10)
    told = tile.info.model_copy(update={"map_sequence": 12, "answer_tiles": 345})
    assert parse_model(TileInfo, tile.told(12, 345)) == told
    assert tile.told(12, 345) == told.model_dump_json().encode()


def answer(reader: Reader, what: str, parameters: str) -> list[tuple]:
    replies: list[tuple] = []
    plan = reader.region(parameters) if what == "region" else reader.tiles(what, parameters)
    plan.answer(lambda *reply: replies.append(reply))
    return sorted(replies)


def test_answers_follow_the_map() -> None:
    """A reader that keeps tiles says what one says that keeps none: after more points here, points far away, which age
    these, and a reset."""
    config = Config.model_validate({"map": {"name": "site"}})
    keeps_none = config.model_copy(update={"query": config.query.model_copy(update={"cache_limit": 1})})
    with filled(config) as rough_map:
        view, keys, emptied = View(rough_map, 5), Keys("site", config.keys), Emptied(1000)
        identity = Identity("site", RUN, INSTANCE, "0" * 32, "map")
        kept, plain = (Reader(view, keys, one, identity, emptied) for one in (config, keeps_none))
        for change in ("none", "points", "far", "reset", "points"):
            if change == "points":
                rough_map.add(some_points(300, 9), S, T0 + 20 * 10**9)
            elif change == "far":
                rough_map.add(some_points(300, 9, (200.0, 0.0)), S, T0 + 40 * 10**9)
            elif change == "reset":
                emptied.note(rough_map)
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
                first, again = answer(kept, what, parameters), answer(kept, what, parameters)
                assert first == again == answer(plain, what, parameters), (change, what, parameters)
