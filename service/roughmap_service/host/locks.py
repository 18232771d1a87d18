"""The log's directory and the store: made, closed to strangers, and held against a second service."""

import fcntl
import os
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from roughmap_schemas.faults import ReportedError
from roughmap_service.host.disk import make_directory, open_lock


class LockError(ReportedError):
    """Log or store can't be this service's; one line that names the place and the mend."""

    exit_code = 2


@contextmanager
def locked(directory: Path, store: Path | None) -> Iterator[None]:
    """Hold the log directory and the store against a second service."""
    locks = {"log.directory": directory / ".lock"}
    if store is not None:
        if store.is_dir():
            raise LockError(f"store.path: {store} is a folder; name a file, such as {store / 'map.db'}")
        if store.is_symlink():
            raise LockError(f"store.path: {store} is a link; name the file that it leads to")
        locks["store.path"] = store.with_name(store.name + ".lock")
    with ExitStack() as stack:
        for setting, path in locks.items():
            with _writing(setting, path.parent):
                make_directory(path.parent)
            if path.parent.stat().st_mode & stat.S_IWOTH:
                raise LockError(
                    f"{path.parent}: everybody on this machine may write there, and forge the map; give log.directory "
                    "and store.path folders of their own, or chmod o-w"
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
    """What is made in here is made in a place that can be: LockError that names the setting where it can't. A disk
    that is full or broken is no matter of settings: a later start may find it well."""
    try:
        yield
    except (PermissionError, FileExistsError, FileNotFoundError, NotADirectoryError) as error:
        mend = f"let the user {os.getuid()} write there, or set {setting} to another place"
        cause = "a file is in its way" if isinstance(error, FileExistsError) else error.strerror
        raise LockError(f"{setting}: {path} can't be written: {cause}; {mend}") from None
