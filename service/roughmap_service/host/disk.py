"""Files and folders that survive a power cut: a new or renamed one is durable once its directory was synced."""

import os
from pathlib import Path
from typing import IO

HANG_SECONDS = 10.0
"""A disk that has not answered for this long hangs. It may come back, but nothing should wait for it."""


def make_directory(directory: Path) -> None:
    """Create a directory and its missing parents, each durable in the one above."""
    if not directory.is_dir():
        make_directory(directory.parent)
        directory.mkdir(exist_ok=True)
        sync_directory(directory.parent)


def sync_directory(directory: Path) -> None:
    """Make the names created or renamed in a directory durable."""
    sync(directory)


def sync(path: Path) -> None:
    """Make the content of a file or directory durable, even if another process wrote it."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def open_lock(path: Path) -> IO[bytes]:
    """Open a lock file, created if it is missing; OSError for a link, which could lead to a file that is not ours."""
    return os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600), "ab")


def create_new(path: Path) -> IO[bytes]:
    """Create a file in place of one that a kill may have left; never follow a link."""
    path.unlink(missing_ok=True)
    return path.open("xb")
