"""What the doctor says of the log that robots make: how fast it grows, and whether its disk has room for it."""

import shutil
from pathlib import Path
from typing import Any

import pytest
from doctor_traffic import NOW, Drive, configuration

from roughmap_schemas import Config
from roughmap_service.cli.doctor import machine
from roughmap_service.cli.doctor.traffic import Traffic
from roughmap_service.run.settings import Settings

GB = 10**9
KEPT = "the service's log grows by 5.0 GB an hour, bounded to 500.0 GB by log.keep"


@pytest.fixture(autouse=True)
def _disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """100 GB are free."""
    usage = shutil.disk_usage("/")._replace(free=100 * GB)
    monkeypatch.setattr(machine.shutil, "disk_usage", lambda _: usage)


def settings(tmp_path: Path, **log: Any) -> Config:
    store = {"path": str(tmp_path / "map.db")}
    return Config.model_validate({"log": {"directory": str(tmp_path / "log"), **log}, "store": store})


@pytest.mark.parametrize(
    ("log", "per_hour", "verdict", "text"),
    [
        ({}, 1 * GB, "ok", "the service's log grows by 1.0 GB an hour, the disk is full in 4 days"),
        ({}, 5 * GB, "note", "the service's log grows by 5.0 GB an hour, the disk is full in 20 hours"),
        ({"keep": 50 * GB}, 5 * GB, "ok", "the service's log grows by 5.0 GB an hour, bounded to 50.0 GB by log.keep"),
        ({"keep": 500 * GB}, 5 * GB, "note", f"{KEPT}, but the disk has room for 100.0 GB only"),
    ],
)  # fmt: skip
def test_a_services_own_figure(tmp_path: Path, log: dict[str, Any], per_hour: int, verdict: str, text: str) -> None:
    (found,) = machine.log_growth(settings(tmp_path, **log), 0, per_hour)
    assert (found.area, found.verdict, found.text) == ("log", verdict, text)
    assert bool(found.remedy) == (verdict == "note")


def test_what_is_heard_is_what_will_be_logged(tmp_path: Path) -> None:
    """By the messages' own sizes; the log adds less than 2 % to clouds of this size."""
    messages = Drive(seconds=8.0).messages()
    heard = [one for one in messages if one.arrival_ns <= NOW + 8 * 10**9]
    sent = sum(len(one.payload) for one in heard)
    traffic = Traffic(Settings(configuration()))
    for one in heard:
        traffic.take(one)
    assert sent <= traffic.heard_bytes <= sent + 50 * len(heard)
    assert traffic.bytes_per_hour(8.0) == pytest.approx(traffic.heard_bytes * 450, abs=1)
    (found,) = machine.log_growth(settings(tmp_path), 3_600_000_000, None)
    text = "of about 3.6 GB an hour, the disk is full in 28 hours"
    assert (found.verdict, found.text) == ("ok", f"what was heard makes a log {text}")
    (found,) = machine.log_growth(settings(tmp_path, compression="zstd"), 3_600_000_000, None)
    assert found.text == f"what was heard makes a log, before compression (zstd), {text}"


@pytest.mark.parametrize(("heard", "measured"), [(2 * GB, 3 * GB), (3 * GB, 2 * GB)])
def test_beside_a_service_the_larger_figure_counts(tmp_path: Path, heard: int, measured: int) -> None:
    (found,) = machine.log_growth(settings(tmp_path), heard, measured)
    assert "3.0 GB an hour" in found.text
    assert found.text.startswith("what was heard" if heard > measured else "the service's log")


@pytest.mark.parametrize("measured", [None, 0])
def test_nothing_heard_says_nothing(tmp_path: Path, measured: int | None) -> None:
    assert machine.log_growth(settings(tmp_path), 0, measured) == []
