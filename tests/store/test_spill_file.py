"""The spill file itself: its size, its end, and disks that are full or damaged."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from disks import SpillDisk
from spill_tools import FAR, S, filled, ground, leave, leave_all, tiles_of

from roughmap_service.store.spill import SLICE_BYTES, Spill, SpillError


def test_the_file_grows_no_further_than_tiles_are_spilled_at_once(spill: Spill) -> None:
    m = filled(spill)
    sizes = []
    for _ in range(4):
        leave_all(m)
        m.add(ground(0), S, 10**9)
        sizes.append(spill.path.stat().st_size)
    assert sizes[1:] == sizes[:1] * 3


@pytest.mark.parametrize("left", [0, 1, 20])
def test_a_full_disk_loses_no_tile(tmp_path: Path, left: int) -> None:
    disk = SpillDisk()
    with Spill(tmp_path / "tiles", 1000 * SLICE_BYTES, write=disk.write) as spill:
        m = filled(spill)
        m.add(FAR, S, 10**9)
        was, tiles = m.digest(), tiles_of(m)
        disk.left = left
        with pytest.raises(OSError, match="space"):
            leave(m)
        assert (m.digest(), m.tile_count - m.resident_tiles, spill.used) == (was, left, left)
        assert tiles_of(m) == tiles
        disk.left = 10**9
        leave(m)
        assert (m.resident_tiles, m.digest()) == (1, was)
        assert tiles_of(m) == tiles


def test_a_short_write_is_a_full_disk(tmp_path: Path) -> None:
    with Spill(tmp_path / "tiles", 10 * SLICE_BYTES, write=lambda *_: 100) as spill:
        m = filled(spill)
        m.add(FAR, S, 10**9)
        with pytest.raises(OSError, match="space"):
            leave(m)
        assert spill.used == 0


def test_what_is_not_as_it_was_written_is_found(spill: Spill) -> None:
    """A flipped bit, by a reader and by the writer; the map stays as it was."""
    m = filled(spill)
    leave_all(m)
    was = m.digest()
    with spill.path.open("r+b") as file:
        file.seek(1000)
        byte = file.read(1)
        file.seek(1000)
        file.write(bytes([byte[0] ^ 1]))
    with pytest.raises(SpillError, match="a tile is damaged"):
        tiles_of(m)
    assert "tiles.spill" in spill.failure
    sequence = m.sequence
    with pytest.raises(SpillError, match="a tile is damaged"):
        m.add(ground(3, 5000), S, 10**9)
    assert (m.digest(), m.sequence, m.resident_tiles) == (was, sequence, 1)


@pytest.mark.parametrize("number", range(6))
def test_places_for_which_there_is_no_memory(spill: Spill, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    calls, true = iter(range(100)), np.append

    def append(*args: Any) -> Any:
        if next(calls) == number:
            raise MemoryError
        return true(*args)

    m = filled(spill)
    was = tiles_of(m)
    m.add(FAR, S, 10**9)  # all else may leave
    with monkeypatch.context() as patch:
        patch.setattr(np, "append", append)
        with pytest.raises(MemoryError):
            leave(m)
    assert spill.used == 0
    leave_all(m)
    assert m.resident_tiles == 1
    assert {tile: tiles_of(m)[tile] for tile in was} == was


def test_the_file_is_created_at_the_start_and_removed_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "tiles"
    with Spill(path, 10 * SLICE_BYTES), pytest.raises(SpillError, match="another service"):
        Spill(path, 10 * SLICE_BYTES)
    assert not path.exists()
    path.write_bytes(b"left over" * 100)
    path.chmod(0o666)
    other_name = tmp_path / "of somebody else"
    other_name.hardlink_to(path)
    with Spill(path, 10 * SLICE_BYTES), other_name.open("rb") as left:
        assert path.stat().st_size == 0
        assert path.stat().st_mode & 0o777 == 0o600, "who laid the old one there, open to all, reads nothing in it"
        assert not path.samefile(other_name)
        assert left.read() == b"left over" * 100
    with pytest.raises(SpillError, match="spill_path"):
        Spill(tmp_path, 10 * SLICE_BYTES)
    with pytest.raises(SpillError, match="not a plain file"):
        Spill(Path("/dev/null"), 10 * SLICE_BYTES)
    assert Path("/dev/null").exists()
