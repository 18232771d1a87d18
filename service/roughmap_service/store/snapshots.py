"""Snapshots: cuts of the run go to the store from a thread of their own, never ahead of the log."""

import logging
import threading
import time
from collections.abc import Callable

from roughmap.reading.frozen import FrozenMap
from roughmap_schemas import Config, configuration_digest
from roughmap_service.host.log_lines import note
from roughmap_service.journal.keep import Needed, delete_oldest
from roughmap_service.journal.writer import LogWriter
from roughmap_service.run.run import Run
from roughmap_service.run.settings import NS
from roughmap_service.run.view import View
from roughmap_service.store.map_db import Cut, Store, StoreError
from roughmap_service.store.spill import Spill, SpillError

log = logging.getLogger(__name__)

SYNC_SECONDS = 10.0
"""How long a snapshot waits for the log to be on the disk through its cut; then the next one tries again."""

HANG_SECONDS = 60.0
"""A store that has taken no tile for so long hangs, or its disk does; a commit of gigabytes takes some of that."""

READ_SECONDS = 0.05
"""How often a snapshot looks whether readings that it must wait for are over."""


def cut_of(run_id: str, config: Config, run: Run) -> Cut:
    """Where the run stands; call it where nothing changes the run meanwhile."""
    oldest = min(run.clouds, default=None)
    return Cut(
        run=run_id,
        epoch=run.epoch,
        sequence=run.map.sequence,
        input=run.input,
        record=run.record,
        low_water=oldest if oldest is not None else run.input + 1,
        configuration=config.public_dict(),
        configuration_digest=configuration_digest(config),
        poses={robot: buffer.to_state() for robot, buffer in run.poses.items()},
        duplicates=run.duplicates.to_state(),
        digest=run.map.digest(),
    )


def take_cut(cut: Cut, run: Run) -> None:
    """Bring a new run to where a cut stands; the inverse of `cut_of`, but for the map's tiles."""
    run.epoch, run.input, run.record = cut.epoch, cut.input, cut.record
    run.newest_stamp_ns = run.map.newest_updated * NS
    for robot, buffer in cut.poses.items():
        run.buffer(robot).load_state(buffer)
    run.duplicates.load_state(cut.duplicates)


class Snapshots:
    """Writes one cut at a time; one that is offered while another is being written is left out.

    After each, the log's oldest files that no longer have to be there are deleted, if it is bounded to ``keep`` bytes.
    """

    def __init__(
        self,
        store: Store | None,
        view: View,
        writer: LogWriter,
        stored: Cut | None,
        *,
        keep: int | None = None,
        spill: Spill | None = None,
    ) -> None:
        self._store = store
        self._view = view
        self._writer = writer
        self._keep = keep
        self._spill = spill
        self._epoch_of_tiles = view.epoch if stored is not None else None
        self._busy = threading.Lock()
        self._thread: threading.Thread | None = None
        self.sequence = stored.sequence if stored is not None else 0
        self._asked: float | None = None  # since when the store is busy with what it was last given
        self.ok = True
        """Whether the store took what it was last given."""
        self.error = ""
        """Why there was no snapshot the last time: the store's fault, or that others were not ready for it."""

    @property
    def enabled(self) -> bool:
        """Whether there is a store."""
        return self._store is not None

    def offer(self, make: Callable[[], Cut]) -> threading.Thread | None:
        """Begin to store the cut that ``make`` gives, the map's present state; call it where nobody changes the map
        meanwhile.

        Returns the thread that writes it, None if there is no store or it is still being written: then no cut is made,
        which costs the sequencer some time (all poses and remembered messages) and memory.
        """
        if self._store is None or not self._busy.acquire(blocking=False):
            return None
        frozen = None
        try:
            cut = make()
            # Tiles stored under another epoch of this process may have been emptied by a reset since.
            after = self.sequence if self._epoch_of_tiles == cut.epoch else None
            with self._view.reading() as rough_map:
                frozen = rough_map.freeze(after=-1 if after is None else after)
                outlived = self._outlived()
            args = cut, frozen, after, outlived
            thread = threading.Thread(target=self._write, args=args, name="snapshot", daemon=True)
            thread.start()
        except (MemoryError, RuntimeError) as error:  # RuntimeError: the system gives no more threads
            self._fail(error)
            self._end(frozen)
            return None
        except BaseException:
            self._end(frozen)
            raise
        self._thread = thread
        return thread

    def look(self) -> None:
        """Look whether the store's disk still answers; call it now and then, since the thread that writes is what
        hangs."""
        asked = self._asked
        if self.ok and asked is not None and time.monotonic() > asked + HANG_SECONDS:
            self._fail(TimeoutError(f"its disk has not answered for {HANG_SECONDS:g} s"))

    def wait(self, timeout: float) -> None:
        """Wait for the snapshot that is being written."""
        if self._thread is not None:
            self._thread.join(timeout)

    def _outlived(self) -> set[int]:
        """Tiles that this cut will overwrite in the store, and that readings begun before still read there."""
        return set() if self._spill is None else set(self._spill.outlived().tolist())

    def _wait_read(self, outlived: set[int]) -> bool:
        """Wait for those readings; False if it takes too long."""
        until = time.monotonic() + SYNC_SECONDS
        while outlived:
            with self._view.reading():
                outlived &= self._outlived()
            if time.monotonic() > until:
                return False
            time.sleep(READ_SECONDS)
        return True

    def _write(self, cut: Cut, frozen: FrozenMap, after: int | None, outlived: set[int]) -> None:
        assert self._store is not None  # noqa: S101 - offer() saw to it
        try:
            if not self._writer.wait_synced(SYNC_SECONDS):
                self.error = "the log could not be made durable through the snapshot"
                return
            if not self._wait_read(outlived):
                self.error = "a reader holds tiles as they were stored before"
                return
            self._went_on()
            self._store.write(cut, frozen, after, self._went_on)
            self._asked = None
            self._epoch_of_tiles, self.sequence, self.error = cut.epoch, cut.sequence, ""
            if not self.ok:
                self.ok = True
                text = f"the map can be stored again: {self._store.path}"
                note(log, logging.WARNING, "snapshot_recovered", text, always=True)
            text = f"the map is stored through sequence {cut.sequence}"
            note(log, logging.INFO, "snapshot", text, sequence=cut.sequence, epoch=cut.epoch)
            self._delete_log(cut)
        except Exception as error:  # noqa: BLE001 - whatever it was, the store is as it was before, and that must show
            self._fail(error)
        finally:
            self._end(frozen)

    def _went_on(self) -> None:
        self._asked = time.monotonic()

    def _fail(self, error: Exception) -> None:
        """The store did not take a snapshot: told once, until it takes one."""
        assert self._store is not None  # noqa: S101 - offer() saw to it
        why = str(error) or "no memory to write it"
        self.error = why if isinstance(error, SpillError | StoreError) else f"{self._store.path}: {why}"
        if self.ok:
            self.ok = False
            text = f"the map can't be stored ({self.error}); the log holds all, and it is tried again"
            note(log, logging.ERROR, "snapshot_failed", text, always=True, cause=self.error)

    def _end(self, frozen: FrozenMap | None) -> None:
        self._asked = None
        if frozen is not None:
            with self._view.reading():
                frozen.close()
        self._busy.release()

    def _delete_log(self, cut: Cut) -> None:
        if self._keep is None:
            return
        try:
            delete_oldest(self._writer.path, Needed(cut.run, cut.record, cut.low_water), self._keep)
        except OSError as error:
            log.error("the log's oldest files could not be deleted: %s", error)
