"""Names that are on the disk: what is created or renamed is safe only once its directory was synced."""

import os
from pathlib import Path
from typing import IO

HANG_SECONDS = 10.0
"""A disk that has not done what it was asked for so long hangs: it may come back, and nobody should wait for that."""


def make_directory(directory: Path) -> None:
    """Make a directory, and those above it that are missing, each durable in the one above."""
    if not directory.is_dir():
        make_directory(directory.parent)
        directory.mkdir(exist_ok=True)
        sync_directory(directory.parent)


def sync_directory(directory: Path) -> None:
    """Make names created or renamed in a directory durable."""
    sync(directory)


def sync(path: Path) -> None:
    """Make what a file holds, or a directory names, durable, whoever wrote it."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def open_lock(path: Path) -> IO[bytes]:
    """Open a file to be locked, made if it isn't there; OSError where there is a link: its end is not ours."""
    return os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600), "ab")


def create_new(path: Path) -> IO[bytes]:
    """Make a file in place of one that a kill may have left; never what a link leads to."""
    path.unlink(missing_ok=True)
    return path.open("xb")
