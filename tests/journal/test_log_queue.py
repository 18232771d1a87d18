"""When the log's thread takes what is queued: small records together, and what is waited for at once."""

from concurrent.futures import Future, ThreadPoolExecutor

import pytest
from net import WAIT_S

from roughmap_schemas.kinds import Kind
from roughmap_service.journal.items import Item, Rotate, Sync
from roughmap_service.journal.queue import PROMPT_BYTES, LogQueue
from roughmap_service.journal.records import LogRecord


def record(size: int = 100) -> LogRecord:
    return LogRecord(Kind.QUERIES, "maps/site/queries", bytes(size), 0, 0)


@pytest.mark.parametrize("last", [Sync(lambda: None), Rotate(""), record(PROMPT_BYTES)])
def test_what_is_waited_for_ends_the_wait_of_all(last: Item) -> None:
    queue = LogQueue(1 << 30)
    items = [record(), record(), record(), last]
    with ThreadPoolExecutor(1) as pool:
        taken: Future[tuple[list[Item], bool]] = pool.submit(queue.take, WAIT_S)
        for item in items:
            queue.put(item)
        assert taken.result(WAIT_S) == (items, False)


def test_many_small_ones_end_it_too() -> None:
    queue, number = LogQueue(1 << 30), PROMPT_BYTES // 1000
    with ThreadPoolExecutor(1) as pool:
        taken = pool.submit(queue.take, WAIT_S)
        for _ in range(number):
            assert queue.put_output(record(1000))
        assert len(taken.result(WAIT_S)[0]) > number // 2


def test_the_wait_ends_in_time_or_with_the_log() -> None:
    queue = LogQueue(1 << 30)
    queue.put(record())
    assert len(queue.take(0.001)[0]) == 1
    with ThreadPoolExecutor(1) as pool:
        taken = pool.submit(queue.take, WAIT_S)
        queue.put(record())
        queue.end()
        items, ending = taken.result(WAIT_S)
        assert ending
        assert len(items) == 1


def test_who_has_nothing_to_do_takes_the_first_at_once() -> None:
    queue = LogQueue(1 << 30)
    with ThreadPoolExecutor(1) as pool:
        taken = pool.submit(queue.take, None)
        queue.put(record())
        assert len(taken.result(WAIT_S)[0]) == 1
