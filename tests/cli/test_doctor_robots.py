"""`roughmap doctor` as a command: beside a service, in its place, and in its way, with robots that publish."""

import json
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import zenoh
from doctor_traffic import LEVEL, timed_cloud
from http_tools import address, pages
from live_service import live_service
from net import peer_config

from roughmap_schemas import encode_odometry
from roughmap_service.cli.main import run
from roughmap_service.inputs.session import endpoints
from roughmap_service.watch.readiness import Readiness, Sources

POINTS = np.ones((10, 3), np.float32)


def doctor(capsys: pytest.CaptureFixture[str], file: Path, *arguments: str) -> tuple[int, dict[str, list[str]]]:
    """Exit code, and the verdicts by area."""
    code = run(
        [
            "doctor",
            "-c",
            str(file),
            "--json",
            "--set",
            "input.queue_limit=1MiB",
            "--set",
            "input.max_message=1MiB",
            *arguments,
        ]
    )
    report = json.loads(capsys.readouterr().out)
    assert report["ok"] == (code == 0)
    areas: dict[str, list[str]] = {}
    for finding in report["findings"]:
        areas.setdefault(finding["area"], []).append(finding["verdict"])
    return code, areas


def heard(capsys: pytest.CaptureFixture[str], file: Path) -> dict[str, list[str]]:
    """The verdicts once the robot is heard: it takes a while to connect."""
    for _ in range(10):
        _, areas = doctor(capsys, file, "--seconds", "1")
        if "r1" in areas:
            return areas
    raise AssertionError("the robot was never heard")


def write(folder: Path, listen: str, connect: str = "") -> Path:
    file = folder / "doctor.toml"
    connects = json.dumps([connect] if connect else [])
    file.write_text(
        f'[map]\nmemory_limit = "1MiB"\n[zenoh]\nlisten = ["{listen}"]\nconnect = {connects}\n'
        f'[log]\ndirectory = "{folder / "log"}"\nqueue_limit = "1MiB"\n[http]\nlisten = ""\n'
        "[sensors.lidar]\nrange_sigma = 0.02\n"
    )
    return file


class Publishing:
    """Robots that publish until they are left: r1 does all right, the others of ``faulty`` have a fault each."""

    def __init__(self, endpoint: str, faulty: tuple[str, ...] = ()) -> None:
        self._endpoint, self._robots = endpoint, ("r1", *faulty)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *error: object) -> None:
        self._end.set()
        self._thread.join()

    def _run(self) -> None:
        with zenoh.open(peer_config(connect=[self._endpoint], mode="client")) as session:
            for number in range(100_000):
                for robot in self._robots:
                    self._publish(session, robot, number)
                if self._end.wait(0.02):
                    return

    @staticmethod
    def _publish(session: zenoh.Session, robot: str, number: int) -> None:
        now, seq = time.time_ns(), number.to_bytes(8, "little")
        stamp = 0 if robot == "unset" else now
        frame = "/map" if robot == "slash" else "map"
        covariance = np.eye(6) * (1e6 if robot == "wheels" else 0.25 if robot == "lost" else 1e-4)
        x = 3.0 * (number // 50) if robot == "leaping" else number * 0.02
        pose = encode_odometry(stamp, frame, (x, 0, 0), LEVEL, covariance)
        session.put(f"robots/{robot}/odometry", pose, attachment=seq)
        if number % 5:
            return
        stamp = (
            0 if robot == "unset" else now - 100_000_000 * (robot != "velodyne") + (37 * 10**9 if robot == "tai" else 0)
        )
        name, times = (
            ("time", np.linspace(-0.09, 0.0, 10)) if robot == "velodyne" else ("t", np.linspace(0.0, 0.09, 10))
        )
        if robot == "shares":
            times = np.linspace(0.0, 1.0, 10)
        cloud = timed_cloud(POINTS, stamp, "lidar", name, times.astype(np.float32))
        session.put(f"robots/{robot}/points", cloud, attachment=(number // 5).to_bytes(8, "little"))


def test_beside_a_service_that_is_up(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with live_service(tmp_path, "[sensors.lidar]\nrange_sigma = 0.02\n") as service:
        endpoint = service.endpoints[0]
        file = write(tmp_path, endpoint)
        with Publishing(endpoint):
            areas = heard(capsys, file)
        with zenoh.open(peer_config(connect=[endpoint], mode="client")) as session:
            assert list(session.get("maps/site/ingest/r1/points", payload=b"no cloud", timeout=30.0))
        assert run(["doctor", "-c", str(file), "--seconds", "0"]) == 0
    told = capsys.readouterr().out
    assert "note   robots    the service has refused 1 messages since its start: bad_message 1\n" in told
    assert areas["zenoh"] == ["ok"]
    assert areas["r1"][:2] == ["ok", "ok"], "clouds and odometry were heard through the service"


EXPECTED = {
    "tai": "clouds in 'lidar' are stamped 37.0 s ahead of the odometry",
    "unset": "poses have no stamp (0)",
    "slash": "odometry in frame '/map' is rejected",
    "wheels": "poses have no estimate of x, y, z, roll, pitch and yaw",
    "lost": "all points are rejected as uncertain: the pose's horizontal error alone is 2 sigma = 1.00 m",
    "leaping": "odometry leapt",
    "shares": "it is unclear how the times of points in 'lidar' are meant: t (float32) from 0 to 1",
}
"""What is wrong with a robot of this name."""


def test_faults_of_robots_beside_a_service(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with live_service(tmp_path, "[sensors.lidar]\nrange_sigma = 0.02\n") as service:
        endpoint = service.endpoints[0]
        file = write(tmp_path, endpoint)
        with Publishing(endpoint, (*EXPECTED, "velodyne")):
            heard(capsys, file)
            assert run(["doctor", "-c", str(file), "--json", "--seconds", "5"]) == 1
            found = json.loads(capsys.readouterr().out)["findings"]
            assert run(["doctor", "-c", str(file), "--seconds", "3"]) == 1
    shown = capsys.readouterr().out
    wrong = {
        robot: [one["text"] for one in found if (one["area"], one["verdict"]) == (robot, "wrong")] for robot in EXPECTED
    }
    for robot, words in EXPECTED.items():
        assert any(words in text for text in wrong[robot]), (robot, wrong)
    assert any("time (float32) in s to the sweep's end" in one["text"] for one in found if one["area"] == "velodyne")
    assert "[robots.tai.sensors.lidar]\n" in shown
    assert any(line.strip() == "time_offset = -37.0" for line in shown.splitlines())


def test_a_service_that_answers_on_its_pages_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """So it is while it starts."""
    with socket.create_server(("127.0.0.1", 0)) as other, pages(Sources(Readiness(), "site")) as server:
        listen, taken = "{}:{}".format(*address(server)), f"tcp/127.0.0.1:{other.getsockname()[1]}"
        file = write(tmp_path, taken)
        file.write_text(file.read_text().replace('[http]\nlisten = ""', f'[http]\nlisten = "{listen}"'))
        code, areas = doctor(capsys, file, "--seconds", "0")
        assert (code, areas["zenoh"], areas["http"]) == (0, ["note"], ["ok"])
        code, areas = doctor(capsys, file, "--seconds", "0", "--set", "map.name=other")
        assert (code, areas["zenoh"], areas["http"]) == (1, ["wrong"], ["wrong"]), "another map's service"


def test_in_the_service_s_place_with_a_router_that_is_there_and_one_that_is_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with zenoh.open(peer_config(listen=True, mode="router")) as router:
        (endpoint,) = endpoints(router)
        with Publishing(endpoint):
            areas = heard(capsys, write(tmp_path, "tcp/127.0.0.1:0", endpoint))
    assert areas["zenoh"] == ["ok", "ok"]
    with socket.create_server(("127.0.0.1", 0)) as other:
        gone = f"tcp/127.0.0.1:{other.getsockname()[1]}"
    code, areas = doctor(capsys, write(tmp_path, "tcp/127.0.0.1:0", gone), "--seconds", "0")
    assert (code, areas["zenoh"]) == (1, ["ok", "wrong"])


def test_a_port_that_another_program_has(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        file = write(tmp_path, f"tcp/127.0.0.1:{other.getsockname()[1]}")
        code, areas = doctor(capsys, file, "--seconds", "0")
        assert (code, areas["zenoh"]) == (1, ["wrong"])
        assert run(["doctor", "-c", str(file), "--seconds", "0"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("wrong  zenoh") for line in lines)
    assert lines[-1].startswith("1 wrong, ")
