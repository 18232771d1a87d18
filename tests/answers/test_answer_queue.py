"""The order in which queries are answered, and what bounds them."""

import threading

import pytest
from net import WAIT_S, wait_for

from roughmap_schemas import QueryFault
from roughmap_service.answers.queue import CELLS_A_PLACE, SMALL_CELLS, AnswerQueue


class Jobs:
    """Jobs that tell when they begin, and end when they are let."""

    def __init__(self, queue: AnswerQueue) -> None:
        self.queue = queue
        self.order: list[str] = []
        self.refused: list[tuple[str, str]] = []
        self.began: dict[str, threading.Event] = {}
        self.let: dict[str, threading.Event] = {}

    def add(self, name: str, cells: int, *, held: bool = False) -> None:
        self.began[name], self.let[name] = threading.Event(), threading.Event()
        if not held:
            self.let[name].set()

        def run() -> None:
            self.order.append(name)
            self.began[name].set()
            wait_for(self.let[name], f"leave to end {name}")

        self.queue.submit(cells, run, lambda fault: self.refused.append((name, fault.code)))

    def wait(self, name: str) -> None:
        wait_for(self.began[name], f"{name} to begin")


def test_small_before_large() -> None:
    with AnswerQueue("t", 1, 10, 10**9) as queue:
        jobs = Jobs(queue)
        jobs.add("first", 1, held=True)
        jobs.wait("first")
        jobs.add("large", 5 * CELLS_A_PLACE)
        jobs.add("small", 10)
        jobs.add("smaller", 0)
        jobs.let["first"].set()
        jobs.wait("large")
    assert jobs.order == ["first", "small", "smaller", "large"]


def test_a_large_one_is_passed_by_few() -> None:
    """One that counts as three places later is passed by at most three that come after it."""
    with AnswerQueue("t", 1, 50, 10**9) as queue:
        jobs = Jobs(queue)
        jobs.add("first", 1, held=True)
        jobs.wait("first")
        jobs.add("large", 3 * CELLS_A_PLACE)
        for k in range(10):
            jobs.add(str(k), 1)
        jobs.let["first"].set()
        jobs.wait("9")
    assert jobs.order.index("large") <= 4


def test_one_worker_is_kept_for_small_ones() -> None:
    with AnswerQueue("t", 2, 10, 10**9) as queue:
        jobs = Jobs(queue)
        jobs.add("large", SMALL_CELLS + 1, held=True)
        jobs.wait("large")
        jobs.add("larger", SMALL_CELLS + 2)
        jobs.add("small", SMALL_CELLS)
        jobs.wait("small")
        assert jobs.order == ["large", "small"]
        jobs.let["large"].set()
        jobs.wait("larger")


def test_what_runs_is_bounded_together() -> None:
    with AnswerQueue("t", 4, 10, 100) as queue:
        jobs = Jobs(queue)
        jobs.add("a", 60, held=True)
        jobs.wait("a")
        jobs.add("b", 60)
        jobs.add("c", 40, held=True)
        jobs.add("status", 0)
        jobs.wait("c")
        jobs.wait("status")
        assert "b" not in jobs.order
        jobs.let["a"].set()
        jobs.let["c"].set()
        jobs.wait("b")


def test_one_larger_than_the_bound_runs_alone() -> None:
    with AnswerQueue("t", 3, 10, 100) as queue:
        jobs = Jobs(queue)
        jobs.add("huge", 1000, held=True)
        jobs.wait("huge")
        jobs.add("other", 1)
        jobs.add("status", 0)
        jobs.wait("status")
        assert "other" not in jobs.order
        jobs.let["huge"].set()
        jobs.wait("other")


def test_too_many_are_busy_and_none_after_the_end() -> None:
    queue = AnswerQueue("t", 1, 2, 100)
    with queue:
        jobs = Jobs(queue)
        jobs.add("runs", 1, held=True)
        jobs.wait("runs")
        jobs.add("waits", 1)
        jobs.add("waits too", 1)
        with pytest.raises(QueryFault, match="busy"):
            jobs.add("one too many", 1)
        closing = threading.Thread(target=queue.close, kwargs={"timeout": WAIT_S})
        closing.start()
        while not jobs.refused:
            closing.join(0.01)
        jobs.let["runs"].set()
        closing.join(WAIT_S)
        assert not closing.is_alive()
        assert {code for _, code in jobs.refused} == {"shutting_down"}
        assert {name for name, _ in jobs.refused} == {"waits", "waits too"}
        with pytest.raises(QueryFault, match="shutting_down"):
            jobs.add("late", 1)


def test_where_too_many_wait_a_small_one_takes_the_place_of_a_large_one() -> None:
    """So that a client which asks for everything in a loop turns itself away and not a planner."""
    with AnswerQueue("t", 1, 3, 10**9) as queue:
        jobs = Jobs(queue)
        jobs.add("first", 1, held=True)
        jobs.wait("first")
        for name in ("a", "b", "c"):
            jobs.add(name, 20 * CELLS_A_PLACE)
        for _ in range(30):  # however often it is turned away
            with pytest.raises(QueryFault, match="busy"):
                jobs.add("d", 20 * CELLS_A_PLACE)
        jobs.add("small", 1)
        assert jobs.refused == [("c", "busy")]
        jobs.let["first"].set()
        jobs.wait("b")
    assert jobs.order == ["first", "small", "a", "b"]
