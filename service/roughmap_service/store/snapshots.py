"""Snapshots: cuts of the run are written to the store in a thread of their own, never ahead of the log."""

import logging
import threading
import time
from collections.abc import Callable

from roughmap.arrays import I4
from roughmap.reading.frozen import FrozenMap
from roughmap_schemas import Config, configuration_digest
from roughmap_service.host.log_lines import note
from roughmap_service.journal.keep import Needed, delete_oldest
from roughmap_service.journal.writer import LogWriter
from roughmap_service.run.run import Run
from roughmap_service.run.sensor_clock import Doubt
from roughmap_service.run.sensor_times import Reading
from roughmap_service.run.settings import NS
from roughmap_service.run.view import View
from roughmap_service.store.map_db import Cut, Store, StoreError
from roughmap_service.store.spill import Spill, SpillError

logger = logging.getLogger(__name__)

SYNC_SECONDS = 10.0
"""The longest wait of a snapshot for the log to be on the disk up to its cut, and for readers. Then it is skipped."""

HANG_SECONDS = 60.0
"""A store that took no tile for this long hangs. A commit of gigabytes takes part of this time."""

READERS_SECONDS = 0.05
"""Pause between checks whether the readers that a snapshot waits for are done."""


def cut_of(run_id: str, config: Config, run: Run) -> Cut:
    """Return the run's present cut. Nothing may change the run meanwhile."""
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
        poses={name: robot.to_state() for name, robot in run.robots.items()},
        doubts={str(number): doubt.to_state() for number, doubt in run.doubts.items()},
        times=run.times.to_state(),
        readings={str(n): None if c.reading is None else c.reading.to_state() for n, c in run.clouds.items()},
        duplicates=run.duplicates.to_state(),
        digest=run.map.digest(),
    )


def take_cut(cut: Cut, run: Run) -> None:
    """Bring a new run to a cut, except for the tiles of its map; the inverse of `cut_of`."""
    run.epoch, run.input, run.record = cut.epoch, cut.input, cut.record
    run.newest_stamp_ns = run.map.newest_updated * NS
    for name, robot in cut.poses.items():
        run.robot(name).load_state(robot)
    run.doubts.update({int(number): Doubt.of_state(doubt) for number, doubt in cut.doubts.items()})
    run.times.load_state(cut.times)
    for number, reading in cut.readings.items():
        run.readings[int(number)] = None if reading is None else Reading.of_state(reading)
    run.duplicates.load_state(cut.duplicates)


class Snapshots:
    """Writes one cut at a time to ``store``; a cut offered meanwhile is skipped.

    ``stored`` is the cut that is in the store at the start. After each snapshot, with ``keep``, the oldest log files
    that are no longer needed are deleted until the log has at most ``keep`` bytes.
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
        self._progress: float | None = None  # when the write that is under way last went on
        self.ok = True
        """Whether the last write to the store succeeded."""
        self.error = ""
        """Why the last snapshot failed or was skipped."""

    @property
    def enabled(self) -> bool:
        """Whether there is a store."""
        return self._store is not None

    def offer(self, make: Callable[[], Cut]) -> threading.Thread | None:
        """Begin to store the cut that ``make`` returns. Nothing may change the map meanwhile.

        Return the thread that writes it, None if there is no store or the last snapshot is still being written. In that
        case ``make`` is not called: a cut holds all poses and remembered messages, which takes time and memory.
        """
        if self._store is None or not self._busy.acquire(blocking=False):
            return None
        frozen = None
        try:
            cut = make()
            # A reset may have emptied tiles that were stored under an earlier epoch.
            after = self.sequence if self._epoch_of_tiles == cut.epoch else None
            with self._view.reading() as rough_map:
                frozen = rough_map.freeze(after=-1 if after is None else after)
                forgot = after is not None and rough_map.forgotten_at > after
                remaining = rough_map.tile_sequences()[0] if forgot else None
                outdated = self._outdated()
            args = cut, frozen, after, outdated, remaining
            thread = threading.Thread(target=self._write, args=args, name="snapshot", daemon=True)
            thread.start()
        except (MemoryError, RuntimeError) as error:  # RuntimeError: no more threads
            self._fail(error)
            self._end(frozen)
            return None
        except BaseException:
            self._end(frozen)
            raise
        self._thread = thread
        return thread

    def look(self) -> None:
        """Check whether the store's disk still answers. Call this regularly; the writing thread can't: it hangs."""
        progress = self._progress
        if self.ok and progress is not None and time.monotonic() > progress + HANG_SECONDS:
            self._fail(TimeoutError(f"its disk has not answered for {HANG_SECONDS:g} s"))

    def wait(self, timeout: float) -> None:
        """Wait at most ``timeout`` s for a snapshot that is being written."""
        if self._thread is not None:
            self._thread.join(timeout)

    def _outdated(self) -> set[int]:
        """Return the places of tiles that the next write replaces and that frozen maps may still read in the store."""
        return set() if self._spill is None else set(self._spill.outdated().tolist())

    def _wait_readers(self, outdated: set[int]) -> bool:
        """Wait until no frozen map needs those tiles; return False if that takes too long."""
        until = time.monotonic() + SYNC_SECONDS
        while outdated:
            with self._view.reading():
                outdated &= self._outdated()
            if time.monotonic() > until:
                return False
            time.sleep(READERS_SECONDS)
        return True

    def _write(self, cut: Cut, frozen: FrozenMap, after: int | None, outdated: set[int], remaining: I4 | None) -> None:
        assert self._store is not None  # noqa: S101 - `offer` checked it
        try:
            if not self._writer.wait_synced(SYNC_SECONDS):
                self.error = f"the log was not on disk up to the cut within {SYNC_SECONDS:g} s; trying again later"
                return
            if not self._wait_readers(outdated):
                self.error = f"a reader still needs the stored tiles after {SYNC_SECONDS:g} s; trying again later"
                return
            self._note_progress()
            self._store.write(cut, frozen, after, self._note_progress, remaining)
            self._progress = None
            self._epoch_of_tiles, self.sequence, self.error = cut.epoch, cut.sequence, ""
            if not self.ok:
                self.ok = True
                text = f"the map can be stored again: {self._store.path}"
                note(logger, logging.WARNING, "snapshot_recovered", text, always=True)
            text = f"the map is stored up to sequence {cut.sequence}"
            note(logger, logging.INFO, "snapshot", text, sequence=cut.sequence, epoch=cut.epoch)
            self._delete_log(cut)
        except Exception as error:  # noqa: BLE001 - whatever the cause, the store is unchanged, and that must show
            self._fail(error)
        finally:
            self._end(frozen)

    def _note_progress(self) -> None:
        self._progress = time.monotonic()

    def _fail(self, error: Exception) -> None:
        """Note that a snapshot failed. It is logged once, until one succeeds."""
        assert self._store is not None  # noqa: S101 - `offer` checked it
        cause = str(error) or "no memory to write it"
        self.error = cause if isinstance(error, SpillError | StoreError) else f"{self._store.path}: {cause}"
        if self.ok:
            self.ok = False
            text = f"the map can't be stored ({self.error}); the log has everything; trying again later"
            note(logger, logging.ERROR, "snapshot_failed", text, always=True, cause=self.error)

    def _end(self, frozen: FrozenMap | None) -> None:
        self._progress = None
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
            logger.error("the log's oldest files could not be deleted: %s", error)
