"""What the answer queue outlives: jobs that fail, and ones that never end."""

import logging
import threading

import pytest
from net import WAIT_S, wait_for

from roughmap_schemas import QueryFault
from roughmap_service.answers.queue import SMALL_CELLS, AnswerQueue


def never(fault: QueryFault) -> None:
    raise AssertionError(f"refused: {fault}")


def test_a_job_that_fails_does_not_take_its_thread_along(caplog: pytest.LogCaptureFixture) -> None:
    done = threading.Event()

    def fail() -> None:
        raise KeyError("of the job")

    with AnswerQueue("t", 1, 10, 100) as queue, caplog.at_level(logging.ERROR):
        queue.submit(100, fail, never)
        queue.submit(100, done.set, never)  # it also needs the room that the first had
        wait_for(done, "the job after it")
    assert "of the job" in caplog.text


def test_the_end_waits_for_a_stuck_job_once_and_in_bounded_time() -> None:
    """A reader that stalls holds its thread; closing again, as the stack of contexts does, adds no second wait."""
    entered, leave = threading.Event(), threading.Event()
    queue = AnswerQueue("stuck", 1, 10, 100)
    with queue:

        def stuck() -> None:
            entered.set()
            leave.wait(WAIT_S)

        queue.submit(1, stuck, never)
        wait_for(entered, "the job")
        queue.close(timeout=0.05)
        again = threading.Thread(target=queue.close, args=(WAIT_S,), daemon=True)
        again.start()
        again.join(WAIT_S / 3)
        assert not again.is_alive(), "the second call waited as well"
    (worker,) = [thread for thread in threading.enumerate() if thread.name == "stuck-0"]
    leave.set()
    worker.join(WAIT_S)
    assert not worker.is_alive()


def test_the_end_does_not_wait_for_askers_that_stall_when_they_are_refused() -> None:
    """The final checkpoint and the log's end come after it. Another asker is refused meanwhile."""
    entered, told, leave = threading.Event(), threading.Event(), threading.Event()

    def stuck() -> None:
        entered.set()
        leave.wait(WAIT_S)

    def tell(fault: QueryFault) -> None:
        assert fault.code == "shutting_down"
        told.set()

    with AnswerQueue("t", 2, 10, 100) as queue:
        queue.submit(100, stuck, never)  # the other worker has no room to run what waits
        wait_for(entered, "the job")
        queue.submit(100, lambda: None, lambda _: stuck())
        queue.submit(100, lambda: None, tell)
        closing = threading.Thread(target=queue.close, args=(0.05,), daemon=True)
        closing.start()
        closing.join(WAIT_S / 3)
        ended = not closing.is_alive()
        wait_for(told, "the asker that listens")
        leave.set()
    assert ended, "the end waited for an asker that stalls"


def test_a_large_one_comes_though_small_ones_keep_coming() -> None:
    """Each small one asks for the next before it ends. The large one counts as 40 places later, and so is passed by 40
    that came after it at most; 3 came before it. The worker that serves only small ones is held up meanwhile, so that
    what the other does is all that counts."""
    begin, done, order = threading.Event(), threading.Event(), []
    places = 40
    with AnswerQueue("t", 2, 10, 10**9) as queue:

        def small() -> None:
            wait_for(begin, "the large one to be submitted")
            if threading.current_thread().name == "t-0":
                queue.submit(1, small, lambda _: None)
                wait_for(done, "the large one")
                return
            order.append("small")
            if not done.is_set() and len(order) < 10 * places:
                queue.submit(1, small, lambda _: None)

        def large() -> None:
            order.append("large")
            done.set()

        for _ in range(3):
            queue.submit(1, small, lambda _: None)
        queue.submit(places * SMALL_CELLS, large, never)
        begin.set()
        wait_for(done, "the large one")
    assert order.index("large") <= places + 3


def test_a_large_one_that_does_not_fit_is_not_passed_for_ever() -> None:
    """Each small one ends only when the next has begun, if that may begin: so there is room for the large one only
    where the queue holds small ones back for it."""
    done, most = threading.Event(), 300
    began = [threading.Event() for _ in range(most + 1)]

    with AnswerQueue("t", 3, 10, 2 * SMALL_CELLS) as queue:

        def small(number: int) -> None:
            began[number].set()
            if number < most and not done.is_set():
                queue.submit(SMALL_CELLS, lambda: small(number + 1), lambda _: None)
                began[number + 1].wait(1.0)  # it begins at once, or is held back

        queue.submit(SMALL_CELLS, lambda: small(0), never)
        wait_for(began[0], "the first small one")
        queue.submit(3 * SMALL_CELLS, done.set, never)
        wait_for(done, "the large one")
        assert not began[most].is_set(), "it had to wait until the small ones ran out"
