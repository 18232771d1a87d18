"""Checks of the machine: directories, disk space, memory, ports, clock."""

import contextlib
import ctypes
import os
import shutil
import socket
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

from roughmap_schemas.config import Config
from roughmap_service.cli.doctor.findings import Finding
from roughmap_service.cli.health import served_map
from roughmap_service.host.log_growth import growth_text, hours_to_full, size_text

EARLIEST, LATEST = (datetime(year, 1, 1, tzinfo=UTC).timestamp() for year in (2025, 2100))
"""A clock that shows a time outside of these is not set."""

BASE_BYTES = 300 << 20
"""Memory of the service without its tiles: code, kernels, Zenoh's pools."""

SHORT_HOURS = 24.0
"""Hours to a full disk below which that is noted."""

LEAST_FREE = 100 << 20
"""Free bytes below which a robot's scans fill the disk within a minute."""

CGROUP_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))

NOT_SYNCHRONISED = 5
"""Result of adjtimex(2) for a clock that is not synchronised (TIME_ERROR)."""


def directories(config: Config) -> list[Finding]:
    """Check that the directories of log and store are writable and have free space."""
    findings = [_directory("log.directory", Path(config.log.directory), 2 * config.log.max_file_bytes)]
    if config.store.path is not None:
        findings.append(_directory("store.path", Path(config.store.path).parent, config.map.memory_limit))
    return findings


def _there(directory: Path) -> Path:
    """Return the nearest directory above that exists."""
    there = directory
    while not there.exists() and there != there.parent:
        there = there.parent
    return there


def _directory(name: str, directory: Path, wanted: int) -> Finding:
    there = _there(directory)
    try:
        if not there.is_dir():
            raise NotADirectoryError(20, "is a file, not a directory", str(there))
        with tempfile.TemporaryFile(dir=there):
            pass
        free = shutil.disk_usage(there).free
    except OSError as error:
        remedy = f"allow user {os.getuid()} to write there, or change {name}"
        return Finding("disk", "wrong", f"{name}: {there} is not writable: {error.strerror}", remedy)
    text = f"{name}: {directory} is writable, {free / 1e9:.1f} GB free"
    if free < LEAST_FREE:
        return Finding("disk", "wrong", text, "free some space: on a full disk no cloud is integrated")
    if free < wanted:
        return Finding("disk", "note", f"{text}, but {wanted / 1e9:.1f} GB may soon be needed", "free some space")
    return Finding("disk", "ok", text)


def log_growth(config: Config, heard: int, measured: int | None) -> list[Finding]:
    """Judge how long the disk of the log lasts.

    ``heard`` are the bytes an hour that robots send, ``measured`` those that a running service's log grew by lately:
    less if they sent nothing for a while, more if it logs other things too. The larger one counts.
    """
    per_hour = max(heard, measured or 0)
    before = "" if config.log.compression == "none" else f", before compression ({config.log.compression}),"
    text = f"what was heard makes a log{before} of about" if per_hour == heard else "the service's log grows by"
    if not per_hour:
        return []
    directory = Path(config.log.directory)
    try:
        used = sum(path.stat().st_size for path in directory.glob("*.mcap*"))
        free = shutil.disk_usage(_there(directory)).free
    except OSError:
        return []  # told by `directories`
    keep = config.log.keep
    hours = hours_to_full(per_hour, free, keep)
    text = f"{text} {growth_text(per_hour, hours, keep)}"
    if keep is not None and keep > used + free:
        text = f"{text}, but the disk has room for {size_text(used + free)} only"
        return [Finding("log", "note", text, "lower log.keep, or give the log another disk (log.directory)")]
    if hours is not None and hours < SHORT_HOURS:
        remedy = "set log.keep (with store.path) or log.compression, or move closed log files away in time"
        return [Finding("log", "note", text, remedy)]
    return [Finding("log", "ok", text)]


def memory(config: Config) -> Finding:
    """Check that the service at map.memory_limit fits into the memory of the machine or the container."""
    have, where = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), "the machine"
    for path in CGROUP_LIMITS:
        with contextlib.suppress(OSError, ValueError):
            limit = int(path.read_text(encoding="ascii"))
            if limit < have:
                have, where = limit, "the container"
    need = config.map.memory_limit + config.input.queue_limit + config.log.queue_limit + BASE_BYTES
    text = f"up to {need / 2**30:.1f} GiB needed (map.memory_limit, queues, base); {where} has {have / 2**30:.1f} GiB"
    if need > have:
        return Finding("memory", "wrong", text, f"lower map.memory_limit, or give {where} more memory")
    return Finding("memory", "ok", text)


def clock() -> Finding:
    """Check that the clock is set and synchronised."""
    now = time.time()
    shown = datetime.fromtimestamp(now, UTC).isoformat(timespec="seconds")
    if not EARLIEST <= now < LATEST:
        return Finding("clock", "wrong", f"the clock shows {shown}", "set it (timedatectl, chrony) before mapping")
    with contextlib.suppress(OSError, AttributeError):
        if ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(512)) == NOT_SYNCHRONISED:
            remedy = "run chrony or systemd-timesyncd, so that the log's times agree with the robots' stamps"
            return Finding("clock", "note", f"the clock shows {shown}, but is not synchronised", remedy)
    return Finding("clock", "ok", f"the clock shows {shown}")


def http_port(config: Config, *, running: bool) -> Finding:
    """Check that the address of the HTTP pages is free, or that the running service answers there."""
    listen = config.http.listen
    if listen is None:
        return Finding("http", "ok", 'http.listen is "": no health pages, no metrics')
    if served_map(config) == config.map.name:
        return Finding("http", "ok", f"http.listen: the running service answers on {listen}")
    host, _, port = listen.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if running and port != "0":
        text = f"http.listen: the running service does not answer on {listen}"
        return Finding("http", "note", text, "was it started with another http.listen or another token?")
    try:
        with socket.create_server((host, int(port)), family=socket.AF_INET6 if ":" in host else socket.AF_INET):
            pass
    except OSError as error:
        remedy = 'stop the other program (ss -ltnp shows it), or change http.listen; "" turns the pages off'
        return Finding(
            "http", "wrong", f"http.listen: {listen}: {str(error.strerror or error).partition(' (')[0]}", remedy
        )
    return Finding("http", "ok", f"http.listen: {listen} is free")
