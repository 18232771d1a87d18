"""Metrics and status come from the same counters, and what is counted has its name and its bound."""

import platform
from pathlib import Path
from types import SimpleNamespace

import pytest
from prometheus_client.parser import text_string_to_metric_families
from served import Served, some_points

from roughmap_schemas.messages import MapStatus
from roughmap_schemas.reasons import CloudReason, PointReason, PoseReason, Refusal
from roughmap_service.host.counters import BOUNDS, MAX_ROBOTS, OTHERS, Counters
from roughmap_service.watch.metrics import Disk, Metrics, PartFigures
from roughmap_service.watch.readiness import Problem

Samples = dict[tuple[str, tuple[tuple[str, str], ...]], float]


def samples(text: bytes) -> Samples:
    """Every sample of a scrape by name and labels, as Prometheus' own parser reads them."""
    found: Samples = {}
    for family in text_string_to_metric_families(text.decode()):
        assert family.documentation, family.name
        for sample in family.samples:
            key = sample.name, tuple(sorted(sample.labels.items()))
            assert key not in found, f"{key} stands twice"
            found[key] = sample.value
    return found


def of(found: Samples, name: str, **labels: str) -> float:
    return found[f"roughmap_{name}", tuple(sorted(labels.items()))]


def scrape(served: Served, directory: Path, figures: PartFigures | None = None) -> Samples:
    assert served.status is not None
    metrics = Metrics(
        served.status, served.counters, lambda: figures or PartFigures(), lambda: {Problem.OVERLOADED: ""},
        lambda: {"robot r1": "robot r1: a \"sentence\""},
        Disk(directory, directory / "map.db", directory / "tiles.spill"), 2**31,
    )  # fmt: skip
    return samples(metrics.text())


def test_metrics_say_what_the_status_says(tmp_path: Path) -> None:
    (tmp_path / "one.mcap").write_bytes(bytes(1000))
    (tmp_path / "two.mcap.torn").write_bytes(bytes(100))
    (tmp_path / "map.db-wal").write_bytes(bytes(10))
    with Served() as served:
        count = served.counters
        count.cloud("integrated", 100, {"range": 7}, None, 0.003)
        for reason in CloudReason:
            count.cloud(reason, 0, {}, None)
        for pose in (None, *PoseReason):
            count.pose(pose)
        for refusal in (Refusal.BAD_KEY, Refusal.BUSY, Refusal.BUSY):
            count.refuse(refusal)
        count.gap("rover1", 3)
        count.jump("rover1")
        count.output_dropped("updates")
        served.add(some_points())
        assert served.status is not None
        status = served.status()
        found = scrape(served, tmp_path, PartFigures(1, 2, 3, 4, 5, snapshot_ok=False, memory_counted=6))
    assert of(found, "clouds_accepted_total") == status.clouds.accepted == 1
    assert of(found, "points_accepted_total") == status.points.accepted == 100
    assert of(found, "poses_accepted_total") == status.poses.accepted == 1
    for kind, reasons, counts in (
        ("clouds_rejected", CloudReason, status.clouds.rejected),
        ("points_rejected", PointReason, status.points.rejected),
        ("poses_rejected", PoseReason, status.poses.rejected),
        ("messages_refused", Refusal, status.refused),
    ):
        told = {reason: of(found, f"{kind}_total", reason=reason) for reason in reasons}
        assert told == {reason: counts.get(reason, 0) for reason in reasons}, kind  # type: ignore[call-overload]
    assert of(found, "messages_missing_total", robot="rover1") == status.gaps["rover1"] == 3
    assert of(found, "transform_jumps_total", robot="rover1") == 1
    assert of(found, "outputs_dropped_total", kind="updates") == 1
    assert of(found, "sequence") == status.sequence
    assert of(found, "tiles", where="resident") == status.tiles.resident
    assert [of(found, "health", state=state) for state in ("ok", "overloaded", "degraded")] == [1, 0, 0]
    assert (of(found, "ready"), of(found, "problem", problem="overloaded")) == (0, 1)
    assert of(found, "input_lost", subject="robot r1", text='robot r1: a "sentence"') == 1
    assert [of(found, "queue_bytes", queue=name) for name in ("intake", "inbox", "log")] == [1, 2, 3]
    assert (of(found, "queries_waiting"), of(found, "snapshot_sequence"), of(found, "snapshot_ok")) == (4, 5, 0)
    assert (of(found, "disk_bytes", what="log"), of(found, "disk_bytes", what="store")) == (1100, 10)
    assert of(found, "disk_bytes", what="spill") == 0, "it is not there"
    assert of(found, "disk_free_bytes", what="log") > 0
    assert of(found, "memory_counted_bytes") == 6
    assert of(found, "build_info", version="9.8.7", python=platform.python_version()) == 1
    assert found["process_open_fds", ()] > 0


def test_durations_are_histograms(tmp_path: Path) -> None:
    with Served() as served:
        for seconds in (0.0, BOUNDS[0], 0.003, 1.5, 60.0):
            served.counters.query("ok", seconds)
        served.counters.query("busy", 0.1)
        served.counters.log_synced(0.004)
        found = scrape(served, tmp_path)
    below = [of(found, "query_seconds_bucket", outcome="ok", le=str(bound)) for bound in BOUNDS]
    assert below == [2, 2, 2, 3, 3, 3, 3, 3, 3, 3, 3, 4, 4, 4], "each bound counts what lies at or below it"
    assert (
        of(found, "query_seconds_bucket", outcome="ok", le="+Inf")
        == of(found, "query_seconds_count", outcome="ok")
        == 5
    )
    assert of(found, "query_seconds_sum", outcome="ok") == 61.5035
    assert of(found, "query_seconds_count", outcome="busy") == 1
    assert of(found, "log_sync_seconds_count") == 1
    assert of(found, "lag_seconds_count") == of(found, "integration_seconds_count") == 0


def test_names_from_outside_make_no_more_series_than_there_may_be_robots() -> None:
    counters = Counters()
    for number in range(MAX_ROBOTS + 50):
        counters.gap(f"robot{number}", 2)
        counters.jump(f"robot{number}")
    counters.gap("robot0", 1)
    counts = counters.snapshot()
    for told in (counts.gaps, counts.jumps):
        assert len(told) == MAX_ROBOTS + 1
    assert (counts.gaps["robot0"], counts.gaps[OTHERS], counts.jumps[OTHERS]) == (3, 100, 50)


def test_a_copy_of_the_counters_stays_as_it_was() -> None:
    counters = Counters()
    counters.query("ok", 0.1)
    before = counters.snapshot()
    counters.query("ok", 0.1)
    counters.refuse("busy")
    assert (sum(before.queries["ok"].counts), before.refused.total()) == (1, 0)


def test_an_overload_ends_when_none_was_dropped_for_a_while_and_none_came_late(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cloud is late that waited for longer than its poses may take (half a second here) and one second more."""
    clock = [0.0]
    monkeypatch.setattr("roughmap_service.host.counters.time", SimpleNamespace(monotonic=lambda: clock[0]))
    counters = Counters(max_wait=0.5)

    def after(seconds: float, waited: float | None = None) -> bool:
        """Whether it is overloaded then, when a cloud that waited for so long has come into the map."""
        clock[0] += seconds
        if waited is not None:
            counters.cloud("integrated", 1, {}, clock[0] - waited)
        return counters.overloaded

    assert not after(1.0, waited=9.0), "one that is late, where none was dropped"
    counters.refuse("busy")
    assert after(1.9)
    assert not after(0.1)
    counters.cloud("overload", 0, {}, None)
    assert after(1.9, waited=1.6)
    assert after(1.9, waited=1.4)
    assert not after(0.1)


def test_a_registration_makes_no_status(tmp_path: Path) -> None:
    """It would wait for the map."""

    def status() -> MapStatus:
        raise AssertionError("asked for a status")

    Metrics(status, Counters(), PartFigures, dict, dict, Disk(tmp_path, None), 1)
