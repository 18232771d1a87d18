"""Names that are on the disk: what is created or renamed is safe only once its directory was synced."""

import os
from pathlib import Path


def make_directory(directory: Path) -> None:
    """Make a directory, and those above it that are missing, each durable in the one above."""
    if not directory.is_dir():
        make_directory(directory.parent)
        directory.mkdir(exist_ok=True)
        sync_directory(directory.parent)


def sync_directory(directory: Path) -> None:
    """Make names created or renamed in a directory durable."""
    handle = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
