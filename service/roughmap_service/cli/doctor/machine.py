"""What the machine must give: directories, room, memory, ports, a clock."""

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

EARLIEST, LATEST = (datetime(year, 1, 1, tzinfo=UTC).timestamp() for year in (2025, 2100))
"""No clock that is set shows less, or more."""

BASE_BYTES = 300 << 20
"""What the service holds beside its tiles: code, kernels, Zenoh's pools."""

LEAST_FREE = 100 << 20
"""Bytes that a robot's scans fill within the minute."""

CGROUP_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))

NOT_SYNCHRONISED = 5
"""What adjtimex(2) returns for a clock that nothing sets right (TIME_ERROR)."""


def directories(config: Config) -> list[Finding]:
    """Log and store can be written, on a disk with room."""
    findings = [_directory("log.directory", Path(config.log.directory), 2 * config.log.max_file_bytes)]
    if config.store.path is not None:
        findings.append(_directory("store.path", Path(config.store.path).parent, config.map.memory_limit))
    return findings


def _directory(name: str, directory: Path, wanted: int) -> Finding:
    there = directory
    while not there.exists() and there != there.parent:
        there = there.parent
    try:
        if not there.is_dir():
            raise NotADirectoryError(20, "is a file, not a directory", str(there))
        with tempfile.TemporaryFile(dir=there):
            pass
        free = shutil.disk_usage(there).free
    except OSError as error:
        mend = f"give the user {os.getuid()} the right to write there, or set {name} to another place"
        return Finding("disk", "wrong", f"{name}: {there} can't be written: {error.strerror}", mend)
    told = f"{name}: {directory} can be written, {free / 1e9:.1f} GB free"
    if free < LEAST_FREE:
        return Finding("disk", "wrong", told, "make room: without it no cloud is integrated")
    if free < wanted:
        return Finding(
            "disk", "note", f"{told}, less than the {wanted / 1e9:.1f} GB that it may soon need", "make room"
        )
    return Finding("disk", "ok", told)


def memory(config: Config) -> Finding:
    """map.memory_limit, and what the service holds beside it, fit into the machine or the container."""
    have, where = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), "the machine"
    for path in CGROUP_LIMITS:
        with contextlib.suppress(OSError, ValueError):
            limit = int(path.read_text(encoding="ascii"))
            if limit < have:
                have, where = limit, "the container"
    need = config.map.memory_limit + config.input.queue_limit + config.log.queue_limit + BASE_BYTES
    told = f"{need / 2**30:.1f} GiB may be needed (map.memory_limit, queues, base); {where} has {have / 2**30:.1f} GiB"
    if need > have:
        return Finding("memory", "wrong", told, "lower map.memory_limit, or give it more")
    return Finding("memory", "ok", told)


def clock() -> Finding:
    """The clock shows a time that can be, and something keeps it right."""
    now = time.time()
    shown = datetime.fromtimestamp(now, UTC).isoformat(timespec="seconds")
    if not EARLIEST <= now < LATEST:
        return Finding("clock", "wrong", f"the clock shows {shown}", "set it (timedatectl, chrony) before mapping")
    with contextlib.suppress(OSError, AttributeError):
        if ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(512)) == NOT_SYNCHRONISED:
            mend = "run chrony or systemd-timesyncd, so that this machine's log agrees with the robots' stamps"
            return Finding("clock", "note", f"the clock shows {shown}, and nothing synchronises it", mend)
    return Finding("clock", "ok", f"the clock shows {shown}")


def http_port(config: Config, *, running: bool) -> Finding:
    """The pages' port is free, or the running service's."""
    listen = config.http.listen
    if listen is None:
        return Finding("http", "ok", 'http.listen is "": no pages, no metrics')
    if served_map(config) == config.map.name:
        return Finding("http", "ok", f"http.listen: {listen}, where the running service answers")
    host, _, port = listen.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if running and port != "0":
        told = f"http.listen: {listen}, where the running service does not answer"
        return Finding("http", "note", told, "was it started with another http.listen, or another token?")
    try:
        with socket.create_server((host, int(port)), family=socket.AF_INET6 if ":" in host else socket.AF_INET):
            pass
    except OSError as error:
        mend = 'stop what listens there (ss -ltnp), or set http.listen to another address, or to ""'
        return Finding(
            "http", "wrong", f"http.listen: {listen}: {str(error.strerror or error).partition(' (')[0]}", mend
        )
    return Finding("http", "ok", f"http.listen: {listen} is free")
