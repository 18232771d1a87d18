"""What the demo does, step by step: service, rover, planner, shutdown, replay, comparison, pictures."""

import json
import re
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from roughmap_client import Region, RoughMapClient
from roughmap_schemas.messages import MapStatus
from roughmap_schemas.reasons import PointReason
from roughmap_service.cli.demo.judging import Judgement, judge
from roughmap_service.cli.demo.planner import QUERY_SIDE_M, Planner
from roughmap_service.cli.demo.processes import RoverProcess, ServiceProcess, replay
from roughmap_service.formats.pictures import draw
from roughmap_service.simulation.rover import POSE_SIGMA, Rover, rovers, sensor_settings
from roughmap_service.simulation.truth import truth

MAP = "demo"

SETTLE_S = 20.0
"""Seconds that the last clouds may take to be decided after the rover has stopped."""

PICTURE_REACH_M = 26.0
"""Half the side of the square that is drawn and compared, around the middle of the rover's path; it sees 25 m."""

LAYERS = ("mean_height", "traversability", "confidence", "interval_95")
"""Layers that are drawn, or compared with the true world."""

REPLAY_LINE = re.compile(r"equal: (\d+) checkpoints, sequence (\d+), digest ([0-9a-f]{32})")


class Progress(Protocol):
    """Shows the progress of the demo."""

    def step(self, text: str) -> None:
        """Show that a step begins."""

    def driven(self, seconds: float) -> None:
        """Show for how many seconds the rover has driven."""


@dataclass(frozen=True)
class Outcome:
    """What the demo measured; `differences` is empty if everything agreed."""

    seconds: float
    robots: int
    scans_published: int
    scans_integrated: int
    scans_rejected: int
    points: int
    points_no_return: int
    points_rejected: int
    points_per_s: float
    driving_s: float
    health: str
    lag_p50_s: float | None
    lag_p99_s: float | None
    queries: int
    query_p50_s: float | None
    query_p99_s: float | None
    map: Judgement
    tiles: int
    memory_bytes: int
    log_bytes: int
    replay_s: float
    wall_s: float
    replay_line: str
    differences: tuple[str, ...]
    pictures: tuple[Path, ...]
    log_directory: Path

    def as_dict(self) -> dict[str, object]:
        """Return JSON values: paths as strings, None for what could not be measured."""
        made = asdict(self)
        made["pictures"] = [str(picture) for picture in self.pictures]
        made["log_directory"] = str(self.log_directory)
        made["equal"] = not self.differences
        return made

    def rows(self) -> list[tuple[str, str]]:
        """Return the table's rows: name and value."""
        rejected = f", {self.scans_rejected} rejected" if self.scans_rejected else ""
        lost = self.scans_published - self.scans_integrated - self.scans_rejected
        dropped = f", {lost} lost on the way" if lost else ""
        slow = ["this machine is too slow for the rover's scans"] if self.health == "overloaded" else []
        side = 2 * PICTURE_REACH_M
        return [
            ("scans", f"{self.scans_integrated} of {self.scans_published} integrated{rejected}{dropped}"),
            ("points", f"{self.points:,} integrated, {self.points_rejected:,} rejected"),
            ("no return", f"{self.points_no_return:,} beams hit nothing within the scanner's range"),
            ("rate", f"{self.points_per_s:,.0f} points/s over {self.driving_s:.1f} s of driving"),
            ("scan to queryable", _figures(("p50", self.lag_p50_s), ("p99", self.lag_p99_s), 1e3, "ms")),
            (
                f"query of {QUERY_SIDE_M:g} x {QUERY_SIDE_M:g} m",
                f"{_figures(('p50', self.query_p50_s), ('p99', self.query_p99_s), 1e3, 'ms')}; {self.queries} queries",
            ),
            (
                "map",
                f"{self.map.known:,} of {self.map.cells:,} cells known in {side:g} x {side:g} m; {self.tiles} tiles",
            ),
            *judgement_rows(self.map),
            ("memory of the service", f"{self.memory_bytes / 2**20:.0f} MiB (RSS)"),
            ("log", f"{self.log_bytes / 1e6:.0f} MB"),
            ("replay", f"{self.replay_s:.1f} s"),
            ("total time", f"{self.wall_s:.0f} s"),
            *(("health", text) for text in slow),
        ]


def judgement_rows(found: Judgement) -> list[tuple[str, str]]:
    """Return how the map compares with the true world; what is unknown has no row."""
    rows = []
    if found.wrongly_free is not None:
        rows.append(("wrongly free", f"{found.wrongly_free:.2%} of {found.blocked:,} blocked cells"))
    if found.wrongly_forbidden is not None:
        grass = found.wrongly_forbidden_hard
        aside = "" if grass is None else f"; {grass:.2%} without tall grass"
        rows.append(("wrongly forbidden", f"{found.wrongly_forbidden:.2%} of {found.free:,} free cells{aside}"))
    if found.height_error_median_m is not None:
        errors = ("median", found.height_error_median_m), ("p95", found.height_error_p95_m)
        rows.append(("height error", f"{_figures(*errors, 100, 'cm')}, from the true ground"))
    if found.covered is not None:
        rows.append(("95 % interval", f"holds the true height in {found.covered:.1%} of the cells"))
    return rows


def run_demo(out: Path, config: Path, *, seconds: float, robots: int, seed: int, progress: Progress) -> Outcome:
    """Run all steps in the folder `out`; the service's configuration goes to `config`."""
    begun = time.monotonic()
    log_directory = (out / "log").resolve()
    start_ns = time.time_ns()
    fleet = rovers(robots, seed, start_ns)
    config.write_text(toml(settings(fleet[0], log_directory)))
    with ExitStack() as stack:
        progress.step("starting the service")
        compiling = partial(progress.step, "compiling the kernels; the first start takes a minute or more")
        service = stack.enter_context(ServiceProcess(config, out / "serve.txt", compiling))
        client = stack.enter_context(RoughMapClient(MAP, connect=service.endpoints, timeout=10.0))
        progress.step(f"service ready on {service.endpoints[0]}; driving for {seconds:g} s")
        driver = stack.enter_context(
            RoverProcess(service.endpoints, seconds, robots, seed, start_ns, out / "simulate.txt")
        )
        with Planner(client, fleet[0]) as planner:
            published = driver.wait(seconds + 60, progress.driven)
        progress.step("stopping the service after the last scans")
        status = settled(client, published["clouds"])
        region = client.region(picture_box(), LAYERS)
        client.close()
        exit_code = service.stop()
    progress.step("replaying the log")
    replay_begun = time.monotonic()
    replay_code, replay_line = replay(log_directory, out / "replay.txt")
    replay_s = time.monotonic() - replay_begun
    progress.step("comparing and drawing")
    judged = judge(
        truth(fleet[0].world, seconds, region.origin, region.cell_size, region["mean_height"].shape),
        region.cell_size,
        region["traversability"],
        region["mean_height"],
        region["interval_95"],
    )
    lag = planner.worst_lag or (status.lag_s.p50, status.lag_s.p99)
    pictures = tuple(
        _draw(out / file, region, layer, fleet, seconds)
        for file, layer in (
            ("height.png", "mean_height"),
            ("traversability.png", "traversability"),
            ("confidence.png", "confidence"),
        )
    )
    return Outcome(
        seconds=seconds,
        robots=robots,
        scans_published=published["clouds"],
        scans_integrated=status.clouds.accepted,
        scans_rejected=sum(status.clouds.rejected.values()),
        points=status.points.accepted,
        points_no_return=status.points.rejected.get(PointReason.NO_RETURN, 0),
        points_rejected=sum(n for reason, n in status.points.rejected.items() if reason != PointReason.NO_RETURN),
        points_per_s=status.points.accepted / published["seconds"],
        driving_s=published["seconds"],
        health=status.health,
        lag_p50_s=lag[0],
        lag_p99_s=lag[1],
        queries=len(planner.latencies),
        query_p50_s=_percentile(planner.latencies, 50),
        query_p99_s=_percentile(planner.latencies, 99),
        map=judged,
        tiles=status.tiles.resident + status.tiles.spilled,
        memory_bytes=status.memory_bytes,
        log_bytes=sum(file.stat().st_size for file in log_directory.glob("*.mcap")),
        replay_s=replay_s,
        wall_s=time.monotonic() - begun,
        replay_line=replay_line,
        differences=tuple(differences(status, planner, exit_code, replay_code, replay_line, judged.known)),
        pictures=pictures,
        log_directory=log_directory,
    )


def settings(rover: Rover, log_directory: Path) -> dict[str, dict[str, object]]:
    """Return the service's configuration: a free port on this machine only, and the rover's scanner."""
    return {
        "map": {"name": MAP},
        "zenoh": {"listen": ["tcp/127.0.0.1:0"], "scouting": False},
        "input": {"pose_sigma": list(POSE_SIGMA)},
        "sensors.lidar": sensor_settings(rover.scanner),
        "log": {"directory": str(log_directory)},
        "http": {"listen": ""},
    }


def toml(tables: Mapping[str, Mapping[str, object]]) -> str:
    """Return TOML for tables of strings, finite numbers, booleans and lists, which TOML writes as JSON does."""
    return "\n".join(
        f"[{table}]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in rows.items())
        for table, rows in tables.items()
    )


def picture_box() -> tuple[float, float, float, float]:
    """Return the box that is queried, drawn and compared, in metres."""
    return -PICTURE_REACH_M, -PICTURE_REACH_M, PICTURE_REACH_M, PICTURE_REACH_M


def settled(client: RoughMapClient, published: int) -> MapStatus:
    """Return the status once every published cloud is decided, or once nothing has changed for a second."""
    deadline = time.monotonic() + SETTLE_S
    status, since = client.status(), time.monotonic()
    while time.monotonic() < deadline:
        decided = status.clouds.accepted + sum(status.clouds.rejected.values())
        still = time.monotonic() - since > 1.0 and status.clouds.waiting == 0
        if still or (status.clouds.waiting == 0 and decided >= published):
            break
        time.sleep(0.1)
        newer = client.status()
        if newer.input != status.input or newer.sequence != status.sequence:
            since = time.monotonic()
        status = newer
    return status


def differences(
    status: MapStatus, planner: Planner, exit_code: int, replay_code: int, replay_line: str, known: int
) -> list[str]:
    """Return one sentence for each thing that should agree and does not."""
    found = []
    equal = REPLAY_LINE.fullmatch(replay_line)
    if exit_code != 0:
        found.append(f"the service ended with exit code {exit_code}")
    if replay_code != 0 or equal is None:
        found.append(f"replay ended with exit code {replay_code}: {replay_line}")
    elif int(equal[2]) != status.sequence:
        found.append(f"the service was at sequence {status.sequence}, its replay at {equal[2]}")
    if status.health == "degraded":
        found.append("the service's health was degraded: it could not write its log or its store")
    if not known:
        found.append("no cell is known")
    found += [f"a query failed: {error}" for error in planner.errors[:3]]
    return found


def _draw(file: Path, region: Region, layer: str, fleet: Sequence[Rover], seconds: float) -> Path:
    elapsed_ns = np.arange(0, seconds, 0.1) * 1e9
    tracks = [rover.pose(rover.start_ns + elapsed_ns).position[:, :2] for rover in fleet]
    draw(region, [layer], file, title=f"roughmap demo: {seconds:g} s of driving", tracks=tracks)
    return file


def _percentile(values: npt.ArrayLike, q: float) -> float | None:
    array = np.asarray(values, dtype=np.float64)
    return float(np.percentile(array, q)) if array.size else None


def _figures(first: tuple[str, float | None], second: tuple[str, float | None], factor: float, unit: str) -> str:
    """Format two figures with their names; None is unknown."""
    return ", ".join(
        f"{name} unknown" if value is None else f"{name} {value * factor:.1f} {unit}" for name, value in (first, second)
    )
