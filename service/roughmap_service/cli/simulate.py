"""`roughmap simulate`: publish the scans and poses of a simulated rover, or of a recording."""

import json
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from roughmap_service.cli.options import Failure, config_options, connect_option, json_option, load, zenoh_option
from roughmap_service.cli.reading import read_options, reading_options
from roughmap_service.host.log_lines import printable

if TYPE_CHECKING:
    from roughmap_service.simulation.publishing import Published, RoverPublisher
    from roughmap_service.simulation.rover import Message


@click.command
@connect_option
@zenoh_option
@click.option("--robots", type=click.IntRange(1, 16), default=1, show_default=True, help="Number of rovers.")
@click.option(
    "--duration", type=click.FloatRange(0.1, 86_400), default=20.0, show_default=True, help="Driving time in seconds."
)
@click.option(
    "--rate",
    type=click.FloatRange(0, 1000),
    default=1.0,
    show_default=True,
    help="Speed, in multiples of real time; 0: as fast as possible.",
)
@click.option(
    "--seed", type=click.IntRange(0, 2**31), default=1, show_default=True, help="Random seed of ground and noise."
)
@click.option(
    "--rings", type=click.IntRange(1, 256), default=64, show_default=True, help="Number of the scanner's beams."
)
@click.option(
    "--columns", type=click.IntRange(8, 4096), default=512, show_default=True, help="Points per beam in one sweep."
)
@click.option(
    "--from",
    "recording",
    type=click.Path(exists=True, path_type=Path),
    help="Publish the messages, or the scans and poses, of this recording instead.",
)
@click.option("--robot", default="rover1", show_default=True, help="With --from: name of the robot.")
@click.option("--sensor-frame", default="lidar", show_default=True, help="With --from: frame of the sensor.")
@click.option("--start-ns", type=click.IntRange(0), help="Stamp of the first sweep, in ns. [default: now]")
@click.option(
    "--wait",
    type=click.FloatRange(0, 3600),
    default=15.0,
    show_default=True,
    help="How long to wait for a service, in seconds.",
)
@reading_options
@config_options
@json_option
def simulate(
    connect: tuple[str, ...],
    zenoh_file: Path | None,
    robots: int,
    duration: float,
    rate: float,
    seed: int,
    rings: int,
    columns: int,
    recording: Path | None,
    robot: str,
    sensor_frame: str,
    start_ns: int | None,
    wait: float,
    config_path: Path | None,
    settings: tuple[tuple[str, object], ...],
    as_json: bool,
    **reading: object,
) -> None:
    """roughmap simulate --duration 20

    Drive a rover through a world whose true state is known, and publish its scans and poses to a running
    `roughmap serve`, as a robot would. The world has slopes, rocks, ditches, trees, a roof, a tunnel, people, a car and
    rain. The scanner turns while the rover moves, and the poses have errors as large as their covariance says.

    The service must know the rover's sensor, `lidar`. `roughmap config example` prints a configuration that has it;
    without it the service refuses the scans.

    With --from, a recording is published; `roughmap build --help` lists the formats. The messages of bags and MCAP
    files go out as they are. Scans go out with their poses as odometry; these are poses of the sensor, so leave
    `translation` out of the sensor's settings. Points in the map frame go out as clouds in `map.frame_id`.
    """
    from roughmap_client.access import endpoints_of
    from roughmap_schemas.config import without_secrets
    from roughmap_service.cli.connection import client_config, if_guarded, open_client
    from roughmap_service.simulation.playing import recorded_messages
    from roughmap_service.simulation.publishing import NobodyListens, RoverPublisher, merged
    from roughmap_service.simulation.rover import rovers
    from roughmap_service.simulation.scanner import Scanner

    loaded = load(config_path, settings)
    if recording is not None:
        options = replace(read_options(loaded.config, robot, reading, any_sensor=True), note=_note)
        messages, fleet = recorded_messages(recording, robot, sensor_frame, options), []
        names = [robot]
    else:
        fleet = rovers(robots, seed, start_ns or 0, Scanner(rings=rings, columns=columns))
        next(fleet[0].messages(1.0))  # compiles the kernels, so that no message is late
        messages = merged([rover.messages(duration) for rover in fleet])
        names = [rover.name for rover in fleet]
    config = client_config(loaded, connect, zenoh_file)
    where = ", ".join(map(without_secrets, endpoints_of(config, "connect")))
    with open_client(config, wait) as session, RoverPublisher(session, names) as publisher:
        try:
            publisher.wait_for_listeners(wait)
        except NobodyListens as error:
            raise Failure(f"{error}; is `roughmap serve` ready on {where}?{if_guarded(config)}") from error
        begun, now = time.monotonic(), time.time_ns()
        for rover in fleet:  # messages are made lazily, so none has a stamp yet
            rover.start_ns = now if start_ns is None else start_ns
        published = _play(publisher, messages, rate, None if recording else duration)
    _report(published, time.monotonic() - begun, as_json)


def _note(line: str) -> None:
    click.echo(f"roughmap: warning: {printable(line)}", err=True)


def _play(
    publisher: "RoverPublisher", messages: "Iterator[Message]", rate: float, seconds: float | None
) -> "Published":
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    stop = threading.Event()
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("publishing", total=seconds)
        first_ns: int | None = None

        def show(published: "Published") -> None:
            nonlocal first_ns
            first_ns = published.last_stamp_ns if first_ns is None else first_ns
            driven = (published.last_stamp_ns - first_ns) / 1e9
            progress.update(task, completed=driven, description=f"{published.clouds} clouds, {published.poses} poses")

        try:
            return publisher.play(messages, rate=rate, stop=stop, on_put=show)
        finally:
            stop.set()


def _report(published: "Published", seconds: float, as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps({**asdict(published), "seconds": seconds}))
        return
    click.echo(
        f"published {published.clouds} clouds and {published.poses} poses, {published.bytes / 1e6:.1f} MB, "
        f"in {seconds:.1f} s (up to {published.late_s * 1e3:.0f} ms late)"
    )
