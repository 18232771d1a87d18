"""The shim between a service and its files and clock: compiled where it is used, and told what is to fail."""

import errno
import mmap
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

SOURCE = Path(__file__).with_name("shim.c")

WORDS = ("clock_ns", "errno", "write", "sync", "rename", "open", "only", "maps", "count", "failed", "hang")
"""The control page's int64 words, as `shim.c` names them."""

ONLY = {"": 0, "log": 1, "store": 2}


class Shim:
    """For services whose log and store lie below ``folder``; give them `environ`. ``journal``: keep one."""

    def __init__(self, folder: Path, *, journal: bool = False) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.root = folder / "disk"
        self.root.mkdir()
        self.journal = folder / "journal"
        library, page = folder / "shim.so", folder / "control"
        command = ["gcc", "-shared", "-fPIC", "-O2", "-o", str(library), str(SOURCE), "-ldl", "-lpthread"]
        built = subprocess.run(command, capture_output=True, text=True, check=False)
        assert built.returncode == 0, f"the shim needs gcc: {built.stderr}"
        page.write_bytes(bytes(4096))
        with page.open("r+b") as file:
            self._page = mmap.mmap(file.fileno(), 4096)
        self.environ = {"LD_PRELOAD": str(library), "FAULTS_ROOT": str(self.root), "FAULTS_CONTROL": str(page)}
        if journal:
            self.environ["FAULTS_JOURNAL"] = str(self.journal)

    def set(self, name: str, value: int) -> None:
        """Set one word."""
        struct.pack_into("<q", self._page, 8 * WORDS.index(name), value)

    @contextmanager
    def hanging(self, *, syncs: bool = True, writes: bool = False, only: str = "") -> Iterator[None]:
        """While it lasts, calls of these kinds don't return."""
        self.set("only", ONLY[only])
        self.set("hang", syncs + 2 * writes)
        try:
            yield
        finally:
            self.set("hang", 0)

    @property
    def failed(self) -> int:
        """Calls that were made to fail."""
        return int(struct.unpack_from("<q", self._page, 8 * WORDS.index("failed"))[0])

    @property
    def journalled(self) -> int:
        """Bytes of the journal so far."""
        return self.journal.stat().st_size if self.journal.exists() else 0

    @contextmanager
    def failing(self, *names: str, every: int = 1, error: int = errno.ENOSPC, only: str = "") -> Iterator[None]:
        """While it lasts, every ``every``-th call of these kinds (write, sync, rename, open, which creates) fails."""
        self.set("errno", error)
        self.set("only", ONLY[only])
        for name in names:
            self.set(name, every)
        try:
            yield
        finally:
            for name in names:
                self.set(name, 0)
