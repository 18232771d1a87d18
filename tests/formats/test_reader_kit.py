"""Every reader of recordings: bounded parts, no digit lost, and one line for whatever is wrong."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from reader_kit import PARTS, SAMPLES, Sample, points_of, read, read_or_fault, small_parts

from roughmap_service.formats.clouds import FOLDERS, READERS, reader_of
from roughmap_service.formats.recorded import CloudFileFault

UTM = np.array([515_396.0, 4_918_348.0, 2_324.0])

ALL = pytest.mark.parametrize("sample", SAMPLES, ids=lambda sample: sample.name)
SOME = settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))


def utm(count: int) -> np.ndarray:
    return UTM + np.random.default_rng(count).uniform(-20, 20, (count, 3))


def test_every_reader_has_a_sample() -> None:
    assert {*READERS.values(), *FOLDERS.values()} <= {sample.reader for sample in SAMPLES}


@ALL
def test_a_sample_is_read_by_its_reader(sample: Sample, tmp_path: Path) -> None:
    reader = reader_of(sample.write(tmp_path, utm(4)))
    assert f"{reader.__module__}.{reader.__name__}" == f"roughmap_service.formats.{sample.reader}"


@ALL
def test_all_digits_are_kept_at_the_size_of_utm_coordinates(sample: Sample, tmp_path: Path) -> None:
    points = utm(1000)
    assert np.array_equal(read(sample, sample.write(tmp_path, points)), sample.held(points))


@ALL
def test_parts_are_bounded(sample: Sample, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = utm(1000)
    path = sample.write(tmp_path, points)
    reader = reader_of(path)
    small_parts(monkeypatch)
    found, rows = points_of(reader(path, sample.options(path)))
    assert np.array_equal(found, sample.held(points))
    assert all(count <= PARTS for count in rows)


@ALL
def test_the_share_that_was_read_rises_to_one(sample: Sample, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = sample.write(tmp_path, utm(1000))
    reader = reader_of(path)
    small_parts(monkeypatch)
    shares: list[float] = []
    points_of(reader(path, replace(sample.options(path), reached=shares.append)))
    assert shares == sorted(shares)
    assert shares[-1] == 1


@ALL
def test_a_cloud_without_points_is_empty(sample: Sample, tmp_path: Path) -> None:
    assert len(read(sample, sample.write(tmp_path, np.empty((0, 3))))) == 0


@ALL
def test_an_empty_file_is_a_fault_or_empty(sample: Sample, tmp_path: Path) -> None:
    path = sample.write(tmp_path, utm(20))
    for damaged in sample.damaged(path):
        whole = damaged.read_bytes()
        damaged.write_bytes(b"")
        found = read_or_fault(sample, path, damaged)
        assert found is None or len(found) < 20
        damaged.write_bytes(whole)


@ALL
def test_a_file_cut_off_is_a_fault_or_shorter(sample: Sample, tmp_path: Path) -> None:
    """Only the last point may differ: a text may end within its digits."""
    points = utm(20)
    path = sample.write(tmp_path, points)
    for damaged in sample.damaged(path):
        whole = damaged.read_bytes()
        for length in range(0, len(whole), max(1, len(whole) // 97)):
            damaged.write_bytes(whole[:length])
            found = read_or_fault(sample, path, damaged)
            if found is not None:
                assert len(found) <= len(points)
                assert np.array_equal(found[:-1], sample.held(points)[: max(len(found) - 1, 0)])
        damaged.write_bytes(whole)


@ALL
@SOME
@given(data=st.data())
def test_bytes_at_random_are_a_fault_or_a_cloud(sample: Sample, tmp_path: Path, data: st.DataObject) -> None:
    folder = tmp_path / "random"
    folder.mkdir(exist_ok=True)
    for old in sorted(folder.rglob("*"), reverse=True):
        old.rmdir() if old.is_dir() else old.unlink()
    path = sample.write(folder, utm(5))
    damaged = data.draw(st.sampled_from(sample.damaged(path)))
    damaged.write_bytes(data.draw(st.binary(max_size=200)))
    read_or_fault(sample, path, damaged)


@ALL
@SOME
@given(data=st.data())
def test_changed_bytes_are_a_fault_or_a_cloud(sample: Sample, tmp_path: Path, data: st.DataObject) -> None:
    folder = tmp_path / "changed"
    folder.mkdir(exist_ok=True)
    for old in sorted(folder.rglob("*"), reverse=True):
        old.rmdir() if old.is_dir() else old.unlink()
    path = sample.write(folder, utm(5))
    damaged = data.draw(st.sampled_from(sample.damaged(path)))
    content = bytearray(damaged.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    damaged.write_bytes(content)
    found = read_or_fault(sample, path, damaged)
    assert found is None or len(found) <= 100 * len(content)


@pytest.mark.parametrize("sample", [s for s in SAMPLES if s.extra], ids=lambda sample: sample.name)
def test_a_missing_extra_is_one_line(sample: Sample, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert sample.extra is not None
    module, extra = sample.extra
    path = sample.write(tmp_path, utm(3))
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(CloudFileFault, match=rf"needs {module}: pip install 'roughmap\[{extra}\]'"):
        read(sample, path)
