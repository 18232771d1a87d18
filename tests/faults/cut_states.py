"""What a power cut may leave on a disk, by the shim's journal: all that was synced, and any part of the rest."""

import random
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

OPEN, WRITE, SYNC, CUT, RENAME, UNLINK, MKDIR = range(1, 8)
HEAD = struct.Struct("<7q")
PAGE = 4096
"""A file's pages go to the disk one by one, in any order."""
SECTOR = 512
"""One that was under way is torn between sectors."""


@dataclass(frozen=True, slots=True)
class Call:
    """One call of the journal, and the journal's length behind it."""

    what: int
    handle: int
    number: int
    flags: int
    first: str
    second: str
    data: bytes
    end: int


def read_journal(path: Path) -> Iterator[Call]:
    """All calls; one that a kill cut short is the end."""
    data, at = path.read_bytes(), 0
    while at + HEAD.size <= len(data):
        what, handle, number, flags, *lengths = HEAD.unpack_from(data, at)
        at += HEAD.size
        if at + sum(lengths) > len(data):
            return
        parts = []
        for length in lengths:
            parts.append(data[at : at + length])
            at += length
        yield Call(what, handle, number, flags, parts[0].decode(), parts[1].decode(), parts[2], at)


@dataclass
class Inode:
    """A file: what is on the disk, and what was done to it since."""

    durable: bytearray = field(default_factory=bytearray)
    pending: list[tuple[int, bytes | None]] = field(default_factory=list)
    """(offset, data), or (length, None) for a cut."""

    def left(self, rng: random.Random) -> bytes:
        """What a cut now may leave of it: of what was not synced nothing, all, the first part, or any pages, torn."""
        kind = rng.choice(("none", "all", "first", "any"))
        pending = self.pending
        if kind == "none":
            pending = []
        elif kind == "first":
            pending = pending[: rng.randint(0, len(pending))]
        elif kind == "any":
            pending = [
                (at, data if data is None or rng.random() < 0.9 else data[: len(data) // SECTOR // 2 * SECTOR])
                for at, data in _pages(pending)
                if rng.random() < 0.7
            ]
        content = bytearray(self.durable)
        for at, data in pending:
            _do(content, at, data)
        return bytes(content)

    def seen(self) -> bytes:
        """What a process reads of it."""
        content = bytearray(self.durable)
        for at, data in self.pending:
            _do(content, at, data)
        return bytes(content)

    def sync(self) -> None:
        """All of it is on the disk."""
        for at, data in self.pending:
            _do(self.durable, at, data)
        self.pending = []


def _pages(pending: list[tuple[int, bytes | None]]) -> Iterator[tuple[int, bytes | None]]:
    for at, data in pending:
        if data is None:
            yield at, None
            continue
        begin = 0
        while begin < len(data):
            end = min(len(data), begin + PAGE - (at + begin) % PAGE)
            yield at + begin, data[begin:end]
            begin = end


def _do(content: bytearray, at: int, data: bytes | None) -> None:
    if data is None:
        del content[at:]
        content.extend(bytes(at - len(content)))
        return
    content.extend(bytes(max(at - len(content), 0)))
    content[at : at + len(data)] = data


@dataclass
class Folder:
    """A directory: its names, those that are on the disk, and how they changed since, which happens in order."""

    names: dict[str, "Inode | Folder"] = field(default_factory=dict)
    durable: dict[str, "Inode | Folder"] = field(default_factory=dict)
    pending: list[tuple[str, "Inode | Folder | None"]] = field(default_factory=list)

    def set(self, name: str, value: "Inode | Folder | None") -> None:
        """Give a name to a file or folder, or take it away."""
        if value is None:
            self.names.pop(name, None)
        else:
            self.names[name] = value
        self.pending.append((name, value))

    def move(self, old: str, new: str) -> None:
        """Rename, at once for both names."""
        value = self.names.pop(old)
        self.names[new] = value
        self.pending.append((f"{old}\0{new}", value))

    def sync(self) -> None:
        """Its names are on the disk."""
        self.durable, self.pending = dict(self.names), []

    def write(self, where: Path, rng: random.Random) -> None:
        """Make what a cut may leave, below ``where``."""
        where.mkdir(parents=True, exist_ok=True)
        left = dict(self.durable)
        for name, value in self.pending[: rng.choice((0, len(self.pending), rng.randint(0, len(self.pending))))]:
            for taken in name.split("\0")[:-1] if "\0" in name else [name] * (value is None):
                left.pop(taken, None)
            if value is not None:
                left[name.rpartition("\0")[2]] = value
        for name, value in left.items():
            if isinstance(value, Folder):
                value.write(where / name, rng)
            else:
                (where / name).write_bytes(value.left(rng))

    def copy(self, where: Path) -> None:
        """Make what a process sees, below ``where``: what is left after a kill."""
        where.mkdir(parents=True, exist_ok=True)
        for name, value in self.names.items():
            if isinstance(value, Folder):
                value.copy(where / name)
            else:
                (where / name).write_bytes(value.seen())


class DiskTree:
    """The tree below ``root`` as the calls made it."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.top = Folder()
        self._open: dict[int, Inode | Folder] = {}

    def take(self, call: Call) -> None:
        """Do what the call did."""
        if call.what == OPEN:
            folder, name = self._place(call.first)
            if name and name not in folder.names:
                assert call.number, f"{call.first} was there before the journal"
                folder.set(name, Inode())
            found = folder.names[name] if name else folder
            if call.flags and isinstance(found, Inode):
                found.pending.append((0, None))
            self._open[call.handle] = found
        elif call.what == MKDIR:
            folder, name = self._place(call.first)
            folder.set(name, Folder())
        elif call.what == RENAME:
            folder, name = self._place(call.first)
            folder.move(name, Path(call.second).name)
        elif call.what == UNLINK:
            folder, name = self._place(call.first)
            folder.set(name, None)
        elif call.what == SYNC:
            self._open[call.handle].sync()
        else:
            target = self._open[call.handle] if call.handle else self._find(call.first)
            assert isinstance(target, Inode)
            target.pending.append((call.number, call.data if call.what == WRITE else None))

    def _place(self, path: str) -> tuple[Folder, str]:
        """The folder that a path's last name lies in, and that name; "" for the root itself."""
        folder, parts = self.top, Path(path).relative_to(self.root).parts
        for part in parts[:-1]:
            step = folder.names[part]
            assert isinstance(step, Folder)
            folder = step
        return folder, parts[-1] if parts else ""

    def _find(self, path: str) -> Inode | Folder:
        folder, name = self._place(path)
        return folder.names[name]
