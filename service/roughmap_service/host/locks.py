"""Locks on the log directory and the store, against a second service and other users of the machine."""

import fcntl
import os
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from roughmap_schemas.faults import ReportedError
from roughmap_service.host.disk import make_directory, open_lock


class LockError(ReportedError):
    """The log directory or the store can't be used by this service; one line with the place and the remedy."""

    exit_code = 2


@contextmanager
def locked(directory: Path, store: Path | None) -> Iterator[None]:
    """Create the log directory and the store's folder, and lock both against a second service; LockError."""
    locks = {"log.directory": directory / ".lock"}
    if store is not None:
        if store.is_dir():
            raise LockError(f"store.path: {store} is a folder; name a file, such as {store / 'map.db'}")
        if store.is_symlink():
            raise LockError(f"store.path: {store} is a link; name the file it leads to")
        locks["store.path"] = store.with_name(store.name + ".lock")
    with ExitStack() as stack:
        for setting, path in locks.items():
            with _writing(setting, path.parent):
                make_directory(path.parent)
            if path.parent.stat().st_mode & stat.S_IWOTH:
                raise LockError(
                    f"{path.parent}: every user of this machine may write there and could forge the map; run chmod o-w "
                    "on it, or set log.directory and store.path to other folders"
                )
            with _writing(setting, path):
                handle = stack.enter_context(open_lock(path))
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise LockError(
                    f"{path}: held by another service; give this one its own log.directory and store.path"
                ) from None
        yield


@contextmanager
def _writing(setting: str, path: Path) -> Iterator[None]:
    """Turn an OSError over a place that can't be written into a LockError that names the setting.

    Errors of a full or broken disk pass: no setting is wrong, and a later start may succeed.
    """
    try:
        yield
    except (PermissionError, FileExistsError, FileNotFoundError, NotADirectoryError) as error:
        remedy = f"let the user {os.getuid()} write there, or set {setting} to another place"
        cause = "a file is in its way" if isinstance(error, FileExistsError) else error.strerror
        raise LockError(f"{setting}: {path} can't be written: {cause}; {remedy}") from None
