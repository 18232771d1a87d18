"""A reset while the disk fails: it comes first when the disk is back, and holds nobody up until then."""

import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest
from disks import FailingDisk
from net import WAIT_S, open_pair, wait_for
from sequencers import ample_memory, sequencer_of
from service_tools import LoggedRun, cloud, config, events_of, read_back

from roughmap import RoughMap
from roughmap.arrays import I4
from roughmap_client import QueryRefused
from roughmap_client.session import ask
from roughmap_schemas import MessageFault, Receipt, ResetEvent
from roughmap_schemas.encodings import POINT_CLOUD
from roughmap_service.engine.recovery import recover
from roughmap_service.engine.sequencer import NotFollowed
from roughmap_service.host.counters import Counters
from roughmap_service.host.ending import ShuttingDown
from roughmap_service.inputs.queue import InputQueue
from roughmap_service.inputs.receipts import ReceiptSender
from roughmap_service.inputs.subscriptions import ZenohInputs


class ResettableRun:
    """A sequencer between real requests and a log on a disk that may fail; its map holds one scan."""

    def __init__(self, directory: Path, stack: ExitStack, emptied: Callable[[I4, int], None] = lambda *_: None) -> None:
        self.disk = FailingDisk()
        server, self.client = stack.enter_context(open_pair())
        self.run = stack.enter_context(LoggedRun(directory, open_file=self.disk.open, emptied=emptied))
        self.run.scan(0.0)
        counters, intake = Counters(), InputQueue(1 << 20, Counters())
        memory = stack.enter_context(ample_memory(directory))
        self.sequencer = sequencer_of(self.run.live, intake, self.run.writer, memory)
        replies = stack.enter_context(ReceiptSender())
        stack.enter_context(ZenohInputs(server, self.run.keys, intake, replies, 1 << 20, counters, self.run.streams))
        stack.callback(lambda: self.sequencer.stop(WAIT_S))
        self.sequencer.start()
        self.sequencer.call(lambda: None, WAIT_S)  # it begins with a checkpoint
        assert self.run.writer.wait_synced(WAIT_S)
        known = threading.Event()
        querier = self.client.declare_querier("maps/site/ingest/rover/transform")  # declared last
        querier.declare_matching_listener(lambda status: known.set() if status.matching else None)
        if not querier.matching_status.matching:
            wait_for(known, "the declarations")

    def ingest(self, t: float) -> Receipt:
        """A cloud in the map's frame, answered when the log holds it."""
        key, payload = "maps/site/ingest/rover/points", cloud(t, frame="map")
        part = ask(self.client, key, timeout=10.0, payload=payload, encoding=POINT_CLOUD).single()
        return Receipt.model_validate_json(part.payload)


def test_a_reset_that_meets_a_full_disk_holds_up_no_refusal_and_comes_when_there_is_room(tmp_path: Path) -> None:
    with ExitStack() as stack:
        service = ResettableRun(tmp_path, stack)
        sequencer, done = service.sequencer, list[tuple[int, int]]()
        before = (service.run.run.map.sequence, service.run.run.epoch)
        service.disk.broken = True
        asking = threading.Thread(target=sequencer.call, args=(lambda: done.append(sequencer.reset()), WAIT_S))
        asking.start()
        wait_for(service.disk.failed, "the disk to refuse the reset")
        with pytest.raises(QueryRefused, match="log_unavailable"):
            service.ingest(1.0)
        turned = sequencer.turned
        with pytest.raises(QueryRefused, match="no room"):
            service.ingest(1.0)
        assert sequencer.turned > turned, "nobody takes it for stalled"
        with pytest.raises(MessageFault, match=r"log_unavailable.*may still be carried out"):
            sequencer.call(lambda: done.append((0, 0)), 0.01)
        assert (service.run.run.map.sequence, service.run.run.epoch, done) == (*before, [])
        service.disk.broken = False
        asking.join(WAIT_S)
        sequencer.call(lambda: None, WAIT_S)  # what was asked before this one is done
        assert done == [(before[0] + 1, before[1] + 1), (0, 0)]
        assert service.run.run.map.digest() == RoughMap().digest()
        assert not service.ingest(1.0).duplicate
    events = events_of(read_back(tmp_path))
    kinds = [event.kind for event in events]
    assert events[kinds.index("reset")] == ResetEvent(epoch=before[1] + 1, sequence=before[0] + 1)
    assert kinds[kinds.index("reset") + 1] == "integration"


def test_a_logged_reset_that_can_not_be_done_ends_the_sequencer_and_the_next_start_does_it(tmp_path: Path) -> None:

    def no_memory(_tiles: I4, _sequence: int) -> None:
        raise MemoryError

    with ExitStack() as stack:
        service = ResettableRun(tmp_path, stack, no_memory)
        before = service.run.run.map.sequence
        with pytest.raises(ShuttingDown, match=r"MemoryError.*the next start carries it out"):
            service.sequencer.call(service.sequencer.reset, WAIT_S)
        assert service.sequencer.stop(WAIT_S)
        assert isinstance(service.sequencer.failure, NotFollowed)
    assert isinstance(events_of(read_back(tmp_path))[-1], ResetEvent), "nothing is logged behind it"
    back = recover(config(), tmp_path, None)
    assert (back.run.map.sequence, back.run.map.digest()) == (before + 1, RoughMap().digest())


def test_a_reset_that_is_not_on_disk_at_the_end_is_not_confirmed(tmp_path: Path) -> None:
    with ExitStack() as stack:
        service = ResettableRun(tmp_path, stack)
        sequencer, told = service.sequencer, list[object]()

        def ask_for_it() -> None:
            try:
                sequencer.call(lambda: told.append(sequencer.reset()), WAIT_S)
            except ShuttingDown as error:
                told.append(str(error))

        service.disk.broken = True
        asking = threading.Thread(target=ask_for_it)
        asking.start()
        wait_for(service.disk.failed, "the disk to refuse the reset")
        assert sequencer.stop(WAIT_S)
        asking.join(WAIT_S)
        assert told == ["the service is stopping; the next start carries out the reset if it reached the disk"]
        service.disk.broken = False
