"""What `roughmap top` says of the log: its file, and how long its disk lasts."""

import pytest
from rich.console import Console

from roughmap_schemas import MapStatus
from roughmap_schemas.messages import LogState
from roughmap_service.cli.top_frame import frame


def shown(log: LogState) -> list[str]:
    """The screen's lines from the log's on."""
    status = MapStatus(
        map="site", run="0" * 32, instance="1" * 32, epoch=1, version="1", frame_id="map", cell_size=0.1, levels=8,
        layers=[], bounds=None, extent=None, error_model="cuboid", configuration_digest="2" * 32, health="ok",
        sequence=0, durable_sequence=0, input=0, newest_stamp_ns=0, clouds={}, points={}, poses={}, refused={},
        gaps={}, jumps={}, lag_s={}, rates={}, memory_bytes=0, tiles={}, log=log, uptime_s=1.0,
    )  # fmt: skip
    console = Console(record=True, width=120)
    console.print(frame(status, [], 0.0))
    lines = [line.strip() for line in console.export_text().splitlines()]
    return lines[next(n for n, line in enumerate(lines) if line.startswith("log ")) :]


@pytest.mark.parametrize(
    ("log", "lines"),
    [
        (LogState(file="log/a.mcap", bytes=1 << 20), ["log     1.0 MiB in a.mcap"]),
        (
            LogState(file="log/a.mcap", bytes=1 << 20, bytes_per_hour=2 * 10**9, hours_to_full_disk=5.0),
            ["log     1.0 MiB in a.mcap", "2.0 GB an hour, the disk is full in 5 hours"],
        ),
        (
            LogState(file="log/a.mcap", bytes=1 << 20, bytes_per_hour=2 * 10**9, keep=10**10),
            ["log     1.0 MiB in a.mcap", "2.0 GB an hour, bounded to 10.0 GB by log.keep"],
        ),
    ],
)
def test_the_logs_growth_is_below_its_file(log: LogState, lines: list[str]) -> None:
    assert shown(log) == lines
