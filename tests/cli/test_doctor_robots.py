"""What `roughmap doctor` says of robots' messages, and the command beside a service, in its place, and in its way."""

import json
import socket
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from http_tools import address, pages
from live_service import live_service
from net import peer_config

from roughmap_schemas import encode_cloud, encode_odometry, encode_transform
from roughmap_schemas.config import Config
from roughmap_schemas.kinds import Kind
from roughmap_service.cli.doctor import robots as doctor_robots
from roughmap_service.cli.doctor.findings import Finding
from roughmap_service.cli.doctor.robots import judge
from roughmap_service.cli.doctor.traffic import Traffic
from roughmap_service.cli.main import run
from roughmap_service.inputs.session import endpoints
from roughmap_service.inputs.subscriptions import ENCODINGS
from roughmap_service.run.settings import Settings
from roughmap_service.watch.readiness import Readiness, Sources

LEVEL = (0.0, 0.0, 0.0, 1.0)
POINTS = np.ones((10, 3), np.float32)
OFFSETS = np.linspace(0, 9e7, 10).astype(np.int64)
SENSORS = {"lidar": {"range_sigma": 0.02}}


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pause of a busy machine is no clock that differs."""
    monkeypatch.setattr(doctor_robots, "CLOCK_S", 60.0)


class Listening:
    """Messages taken up one by one, stamped by the wall clock, and what is found in them."""

    def __init__(self, **settings: Any) -> None:
        # A wait that no pause of a busy machine reaches.
        inputs = {"max_wait": 30.0, **settings.pop("input", {})}
        self.config = Config.model_validate({"sensors": SENSORS, "input": inputs, **settings})
        self.traffic = Traffic(Settings(self.config))
        self.now = time.time_ns()

    def take(self, kind: Kind, payload: bytes, robot: str = "r1", encoding: str = "", numbered: bool = True) -> None:
        self.traffic.take(kind, robot, payload, encoding or ENCODINGS[kind], numbered=numbered)

    def cloud(self, after_s: float = 0.0, frame: str = "lidar", timeless: bool = False, **how: Any) -> None:
        stamp = self.now + round(after_s * 1e9)
        self.take(Kind.POINTS, encode_cloud(POINTS, stamp, frame, offsets_ns=None if timeless else OFFSETS), **how)

    def pose(self, after_s: float, frame: str = "map", covariance: Any = "given", **how: Any) -> None:
        matrix = np.eye(6) * 1e-4 if isinstance(covariance, str) else covariance
        stamp = self.now + round(after_s * 1e9)
        self.take(Kind.ODOMETRY, encode_odometry(stamp, frame, (0, 0, 0), LEVEL, matrix), **how)

    def found(self) -> list[Finding]:
        # Listening ended so long after the last message that a pose would have come.
        self.traffic.ended = time.monotonic() + 10.0
        return judge(self.traffic, self.config, 5.0)

    def not_well(self) -> list[tuple[str, str]]:
        """Verdict and words of all that is not well."""
        return [(finding.verdict, finding.text) for finding in self.found() if finding.verdict != "ok"]


def well(listening: Listening, robot: str = "r1") -> None:
    """A robot that does all right: poses around a cloud."""
    listening.pose(-0.01, robot=robot)
    listening.cloud(0.0, robot=robot)
    listening.pose(0.2, robot=robot)


def only(listening: Listening) -> tuple[str, str]:
    (finding,) = listening.not_well()
    return finding


def test_a_robot_that_does_all_right() -> None:
    listening = Listening()
    well(listening)
    assert listening.not_well() == []
    told = [finding.text for finding in listening.found()]
    assert told[0].endswith("Hz, 10 points each, in 'lidar'")
    assert told[1].endswith("in 'map'")
    assert told[2].startswith("poses follow their clouds within ")


def test_nobody() -> None:
    verdict, text = only(Listening())
    assert (verdict, "no messages on robots/*/points" in text) == ("wrong", True)


def test_names_that_are_expected_and_names_that_are_not() -> None:
    listening = Listening(input={"robots": ["r1", "r2"]}, sensors={**SENSORS, "camera": {"range_sigma": 0.1}})
    well(listening)
    well(listening, robot="r3")
    assert listening.not_well() == [
        ("wrong", "is not in input.robots: all its messages are refused"),
        ("note", "nothing from r2 (input.robots)"),
        ("note", "no cloud of sensor camera within 5 s"),
    ]


@pytest.mark.parametrize(
    ("messages", "verdict", "words"),
    [
        (lambda one: one.cloud(0.0, frame="os0"), "wrong", "frame 'os0' are refused: it is neither the map's frame"),
        (lambda one: one.cloud(0.0, timeless=True), "note", "1 of 2 clouds in 'lidar' have no per-point times"),
        (lambda one: one.pose(1.0), "wrong", "poses were up to 0.80 s apart"),
        (lambda one: one.pose(0.1, covariance=None), "note", "1 of 3 poses have no covariance"),
        (lambda one: one.pose(0.1, covariance=-np.eye(6)), "wrong", "1 of 3 poses have an invalid covariance"),
        (lambda one: one.pose(0.1, frame="odom"), "note", "frame 'odom' is rejected: no transform leads to 'map'"),
        (lambda one: one.cloud(0.5), "wrong", "1 of 2 clouds had no pose within input.max_wait = 30 s"),
        (lambda one: one.take(Kind.POINTS, b"\xff"), "wrong", "1 of 2 clouds can't be read; 1: bad_message"),
        (lambda one: one.pose(0.1, encoding="text/plain"), "wrong", "1 of 3 odometry can't be read; 1: bad_encoding"),
    ],
)  # fmt: skip
def test_one_thing_that_is_not_well(messages: Any, verdict: str, words: str) -> None:
    listening = Listening()
    well(listening)
    messages(listening)
    found = only(listening)
    assert found[0] == verdict, found
    assert words in found[1]
    assert all(finding.remedy for finding in listening.found() if finding.verdict != "ok")


def test_frames_that_a_transform_joins() -> None:
    listening = Listening()
    listening.take(Kind.TRANSFORM, encode_transform(listening.now, "map", "odom", (0, 0, 0), LEVEL))
    well(listening)
    listening.pose(0.1, frame="odom")
    assert listening.not_well() == []
    listening.pose(0.15, frame="vio")
    assert only(listening)[0] == "wrong", "the transforms that are published don't lead there"


def test_poses_are_needed_but_for_clouds_in_the_maps_own_frame() -> None:
    listening = Listening()
    listening.cloud(0.0, frame="map", robot="placed")
    listening.cloud(0.0, robot="bare")
    assert only(listening) == ("wrong", "no odometry: its clouds can't be placed")


def test_clocks_that_differ() -> None:
    listening = Listening()
    for robot, poses_s in (("one", -3600.0), ("old", 0.0)):
        listening.pose(poses_s - 0.01, robot=robot)
        listening.cloud(0.0, robot=robot)
        listening.pose(poses_s + 0.2, robot=robot)
        listening.now -= round(3600e9)
    by_words = {text.split(" by ")[0].split(" are ")[0]: verdict for verdict, text in listening.not_well()}
    assert by_words["stamps of clouds and odometry differ"] == "wrong"
    assert by_words["stamps"] == "note", "a recording of an hour ago"


def test_numbers_that_are_missing_are_reported_once() -> None:
    listening = Listening()
    for stamp, kind in ((-0.01, "pose"), (0.0, "cloud"), (0.2, "pose")):
        getattr(listening, kind)(stamp, numbered=False)
    assert "message_seq" in only(listening)[1]


def test_names_from_outside_are_bounded() -> None:
    listening = Listening()
    for number in range(300):
        listening.pose(0.0, robot=f"r{number}")
        listening.pose(0.1 + number, frame=f"f{number}")
    assert len(listening.traffic.robots) == 256
    assert len(listening.traffic.robots["r0"].pose_frames) == 1
    assert len(listening.traffic.robots["r1"].pose_frames) == 64


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
    """A robot that does all right, until it is left."""

    def __init__(self, endpoint: str) -> None:
        self._endpoint = endpoint
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
                now, seq = time.time_ns(), number.to_bytes(8, "little")
                pose = encode_odometry(now, "map", (0, 0, 0), LEVEL, np.eye(6) * 1e-4)
                session.put("robots/r1/odometry", pose, attachment=seq)
                cloud = encode_cloud(POINTS, now - 50_000_000, "lidar", offsets_ns=OFFSETS // 10)
                session.put("robots/r1/points", cloud, attachment=seq)
                if self._end.wait(0.02):
                    return


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
