"""Readers and the one writer of a map: who waits for whom."""

import sys
import threading
from collections.abc import Callable, Iterator

import pytest
from net import WAIT_S, wait_for
from served import INSTANCE, RUN, T0, S, filled, some_points

from roughmap_schemas import Config, Keys
from roughmap_schemas.messages import TileInfo, parse_model
from roughmap_service.answers.emptied_tiles import EmptiedHistory
from roughmap_service.answers.map_reader import MapReader
from roughmap_service.answers.plan import Plan, Reply
from roughmap_service.answers.region import plan_region
from roughmap_service.answers.served_map import ServedMap
from roughmap_service.answers.tiles import TileQueries
from roughmap_service.run.view import View

CONFIG = Config.model_validate({"map": {"name": "site"}})
TILES = "maps/site/tiles/0/*/*"
BOX = "bbox=-3,-3,5,5"


@pytest.fixture
def view() -> Iterator[View]:
    with filled(CONFIG) as rough_map:
        yield View(rough_map, 5)


class Asked:
    """Queries on a map, answered without a network; tiles that one has drawn are kept for the next."""

    def __init__(self, view: View) -> None:
        served = ServedMap("site", RUN, INSTANCE, "0" * 32, "map", "all")
        self._reader = MapReader(view, Keys("site", CONFIG.keys), CONFIG, served, EmptiedHistory(1000))
        self._tiles = TileQueries(self._reader)

    def tiles(self, key: str, parameters: str) -> list[Reply]:
        return replies(self._tiles.plan(key, parameters))

    def region(self, parameters: str) -> list[Reply]:
        return replies(plan_region(self._reader, parameters))


def replies(plan: Plan) -> list[Reply]:
    with plan.read() as answer:
        return list(answer.replies)


class Beside:
    """Runs something in a thread of its own; ``done`` says that it came to its end."""

    def __init__(self, work: Callable[[], object]) -> None:
        self.done = threading.Event()
        self.found: object = None

        def run() -> None:
            self.found = work()
            self.done.set()

        threading.Thread(target=run, daemon=True).start()


def queries(asked: Asked) -> list[Callable[[], list[Reply]]]:
    return [
        lambda: asked.tiles(TILES, BOX),
        lambda: asked.tiles(TILES, f"{BOX};since=2;epoch=5"),
        lambda: asked.region(f"{BOX};layers=mean_height,count,age"),
        lambda: asked.tiles("maps/site/tiles/2/*/*", "layers=slope"),
    ]


def test_what_is_drawn_already_is_answered_while_the_map_changes(view: View) -> None:
    """At the sequence before the change, which nobody can tell from an answer right before it."""
    asked = Asked(view)
    before = [ask() for ask in queries(asked)]
    with view.change() as rough_map:
        rough_map.add(some_points(300, 9), S, T0 + 20 * 10**9)
        for ask, expected in zip(queries(asked), before, strict=True):
            beside = Beside(ask)
            wait_for(beside.done, "an answer during a change")
            assert beside.found == expected
    for ask, old in zip(queries(asked), before, strict=True):
        assert ask() != old


def test_what_is_not_drawn_waits_for_the_end_of_the_change(view: View) -> None:
    asked = Asked(view)
    asked.tiles(TILES, "bbox=-3,-3,0,0")
    with view.change() as rough_map:
        standing = view.standing
        assert standing is not None
        assert standing.sequence == rough_map.sequence
        rough_map.add(some_points(300, 9), S, T0 + 20 * 10**9)
        sequence = rough_map.sequence
        more = Beside(
            lambda: {parse_model(TileInfo, reply.attachment or b"").map_sequence for reply in queries(asked)[0]()}
        )
        all_tiles = Beside(lambda: asked.tiles(TILES, "bbox=-3,-3,0,0;since=1;epoch=4"))
        wait_for(all_tiles.done, "an answer from the cache: nothing was emptied")
        assert not more.done.is_set()
    wait_for(more.done, "an answer after the change")
    assert more.found == {sequence}
    assert view.standing is None


@pytest.fixture
def no_switches() -> Iterator[None]:
    """A thread keeps the interpreter until it blocks: who runs next is then no matter of chance."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(10 * WAIT_S)
    yield
    sys.setswitchinterval(before)


@pytest.mark.usefixtures("no_switches")
def test_a_reader_that_waits_comes_before_the_next_change(view: View) -> None:
    """A plain lock would go to the writer again: it never blocks between two changes."""
    for _ in range(20):
        comes, was_in = threading.Event(), threading.Event()

        def read(comes: threading.Event = comes, was_in: threading.Event = was_in) -> None:
            comes.set()
            with view.reading():
                was_in.set()

        with view.change():
            waiting = Beside(read)
            wait_for(comes, "the reader")  # it goes on from there until it waits for the map
        with view.change():
            assert was_in.is_set()
        wait_for(waiting.done, "the reader to end")


@pytest.mark.parametrize("use", ["change", "reading"])
def test_what_is_let_go_while_the_map_is_in_use_is_closed_at_the_end_of_that_use(view: View, use: str) -> None:
    """The reader does not wait, and nobody has to take the map once more for its tiles to be free."""
    frozen = view.map.freeze(0)
    with getattr(view, use)():
        beside = Beside(lambda: view.let_go(frozen))
        wait_for(beside.done, "a reader to let go, which must not wait")
        assert frozen.records(0, 0)["count"].any()
    with pytest.raises(ValueError, match="closed"):
        frozen.records(0, 0)
