"""The files of a run: found, checked to be complete, and read in order."""

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from roughmap_schemas import RunMetadata
from roughmap_service.journal.reader import LogError, TornLog, read_file, read_metadata
from roughmap_service.journal.records import EventRecord, InputRecord, LogItem


@dataclass(frozen=True, slots=True)
class RunFile:
    """A log file and its metadata record."""

    path: Path
    metadata: RunMetadata


def find_files(paths: Iterable[Path]) -> list[RunFile]:
    """Return the log files among files and folders, each once, ordered by run and index.

    LogError for a file that is not a log. A file in a folder is skipped if a kill kept its beginning from the disk: it
    holds nothing of any run.
    """
    found: dict[Path, RunFile] = {}
    for path in paths:
        try:
            if not path.is_dir():
                found[path.resolve()] = RunFile(path, read_metadata(path))
                continue
            for file in path.glob("*.mcap"):
                with contextlib.suppress(TornLog):
                    found[file.resolve()] = RunFile(file, read_metadata(file))
        except OSError as error:
            raise LogError(f"{error.filename or path}: {error.strerror or error}") from None
    return sorted(found.values(), key=lambda file: (file.metadata.run, file.metadata.index, file.path))


def one_run(files: Sequence[RunFile], found_in: Sequence[Path] = ()) -> list[RunFile]:
    """Check that the files are one run without a gap; LogError names what is missing or superfluous.

    ``found_in`` are the places that were searched, for the error if there are no files.
    """
    if not files:
        raise LogError(f"no log files (*.mcap) in {', '.join(map(str, found_in)) or 'no folder'}")
    runs = sorted({file.metadata.run for file in files})
    if len(runs) > 1:
        raise LogError(f"logs of {len(runs)} runs ({', '.join(run[:8] for run in runs)}...): name the files of one")
    for before, after in pairwise(files):
        number = before.metadata.index
        if after.metadata.index == number:
            raise LogError(f"{before.path} and {after.path} are both file {number} of run {runs[0][:8]}: name one")
        if after.metadata.index != number + 1:
            raise LogError(
                f"gap: file {number + 1} of run {runs[0][:8]} is missing "
                f"between {before.path.name} and {after.path.name}: put it back, or start a new map with serve --fresh"
            )
    return list(files)


def read_run(files: Sequence[RunFile]) -> Iterator[LogItem]:
    """Yield all items of a run's files in order.

    A file may end in a tear: the last one after a kill, an earlier one if it was left because the disk failed. Nothing
    is missing if the next file begins with the numbers that follow. LogError (gap) otherwise.
    """
    number = position = 0
    for at, file in enumerate(files):
        first = file.metadata
        if at and (first.first_input, first.first_record) != (number + 1, position + 1):
            raise LogError(
                f"gap: {file.path.name} begins with input {first.first_input}, record {first.first_record}; "
                f"expected {number + 1}, {position + 1}"
            )
        number, position = first.first_input - 1, first.first_record - 1
        try:
            for item in read_file(file.path):
                if isinstance(item, InputRecord):
                    number, position = item.number, item.record
                elif isinstance(item, EventRecord):
                    position = item.record
                yield item
        except TornLog:
            continue
