"""Files with noise in them or without their end: told in one line that names them, and nothing is made up of them."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from properties import examples
from service_tools import LoggedRun, read_back

from roughmap_service.journal.reader import LogError, TornLog, read_file, read_metadata
from roughmap_service.journal.records import LogItem
from roughmap_service.journal.run_files import RunFile, read_run


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of a run, with its footer."""
    directory = tmp_path_factory.mktemp("log")
    with LoggedRun(directory) as run:
        for n in range(3):
            run.scan(float(n))
            run.checkpoint()
    (path,) = directory.iterdir()
    return path


def read(path: Path) -> tuple[list[LogItem], LogError | None]:
    """What the reader gives of a file, and how it ended; any other error than LogError is the test's."""
    items = []
    try:
        for item in read_file(path):
            items.append(item)  # noqa: PERF402 - what came before the end counts
    except LogError as error:
        return items, error
    return items, None


@examples(100, HealthCheck.function_scoped_fixture)
@given(place=st.floats(0, 1), length=st.integers(1, 3000), seed=st.integers(0, 2**32 - 1), keep=st.booleans())
def test_noise_is_reported(closed: Path, tmp_path: Path, place: float, length: int, seed: int, keep: bool) -> None:
    """In the midst of a file, or instead of its end: whatever lengths it claims, nothing large is allocated."""
    data = closed.read_bytes()
    at = int(place * (len(data) - 1))
    path = tmp_path / closed.name
    path.write_bytes(data[:at] + np.random.default_rng(seed).bytes(length) + (data[at + length :] if keep else b""))
    items, fault = read(path)
    whole = read(closed)[0]
    if fault is None:
        assert items[1:] == whole[1:]
    else:
        assert str(path) in str(fault)
        assert "\n" not in str(fault)


def test_a_tear_in_the_midst_of_a_run_is_a_gap_only_if_something_is_missing(tmp_path: Path) -> None:
    """A file left behind when the disk failed has no footer, and what it lacks is first in the next one."""
    with LoggedRun(tmp_path) as run:
        run.scan(0.0)
        run.rotate()
        run.scan(1.0)
    whole = read_back(tmp_path)
    first, second = sorted(tmp_path.iterdir())
    files = [RunFile(path, read_metadata(path)) for path in (first, second)]
    data = first.read_bytes()
    # The data end record: opcode 15, of four bytes; no record of the run stands behind it.
    end = data.rindex(b"\x0f" + (4).to_bytes(8, "little"))
    first.write_bytes(data[:end])
    with pytest.raises(TornLog):
        list(read_file(first))
    assert list(read_run(files))[1:] == whole[1:]
    first.write_bytes(data[: end - 300])  # within the last chunk
    with pytest.raises(LogError, match=r"gap: .* begins with input 4, record 6; expected 1, 1"):
        list(read_run(files))
