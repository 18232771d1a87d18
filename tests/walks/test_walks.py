"""`make walks`, shortened, and its parts. Of times nothing is asserted here."""

import json
import math
import re
import sys
from pathlib import Path
from random import Random

import numpy as np
import pytest
import walks_paths  # noqa: F401 - before what it makes importable
from processes import T0
from walk_faults import FAULTS
from walk_paste import merged, pasted, quoted, try_pasted
from walk_report import cell, findings, table
from walk_sender import Told, draw
from walk_trial import TOGETHER, batches, named, walk_all
from walker import Message, Walker, encode_points, ground

from roughmap_schemas import decode_cloud, decode_odometry
from roughmap_schemas.kinds import Kind

LIMIT_S = 60.0
"""For a busy machine; `make walks` wants 10 s."""

SHORT = ("sensor_ahead", "covariance_wide", "frame_slash", "none")

RELIABILITY = Path(__file__).parents[2] / "RELIABILITY.md"


def test_a_short_walk_names_all_faults_and_doctors_settings_mend_them(tmp_path: Path) -> None:
    walks = [draw(name, 3, 15.0 * lane) for lane, name in enumerate(SHORT)]
    walk_all(tmp_path / "first", walks, LIMIT_S, lambda _: None)
    advised = pasted(walks)
    assert {walk.name for walk in advised} == {"sensor_ahead", "covariance_wide"}
    try_pasted(tmp_path / "pasted", advised, LIMIT_S)
    assert findings(walks, math.inf) == [], table(walks, LIMIT_S)


def some_messages(walker: Walker) -> list[tuple[float, Message]]:
    sent = []
    for at, message in walker.messages(T0):
        if at > 2.0:
            return sent
        sent.append((at, message))
    raise AssertionError("a walker never ends")


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_drawn_from_the_seed_and_changes_what_is_sent(name: str) -> None:
    for seed in range(12):
        payloads = []
        for _ in range(2):
            walk = draw(name, seed)
            messages = some_messages(walk.walker)
            changed = [one for _, message in messages for one in walk.fault.effect(message)]
            payloads.append([None if one.lost else one.payload() for one in changed])
        assert payloads[0] == payloads[1]
        assert (payloads[0] == [message.payload() for _, message in messages]) == (name == "none")
        names = walk.fault.names
        for words in (*(names.log or ()), names.health, names.doctor, names.advice):
            re.compile(words)
        assert name == "none" or (names.log and names.health and names.doctor), "all name every fault"


def test_a_walker_sends_in_order_at_its_rates_and_what_it_sends_can_be_read() -> None:
    walker = Walker.draw("it", 0.0, Random(2), timed=True)
    sent = some_messages(walker)
    assert [at for at, _ in sent] == sorted(at for at, _ in sent)
    poses = [message for _, message in sent if message.kind is Kind.ODOMETRY]
    assert len(poses) == pytest.approx(2.0 * walker.odometry_hz, abs=2)
    read = decode_odometry(poses[-1].payload(), max_message=1 << 20)
    assert read.stamp_ns == T0 + round(poses[-1].made * 1e9)
    assert read.position == walker.position(poses[-1].made)
    for scanner in walker.scanners:
        clouds = [(at, message) for at, message in sent if message.sensor == scanner.frame]
        assert len(clouds) == pytest.approx(1.7 * scanner.hz, abs=2)
        for at, message in clouds:
            assert at >= message.made + message.times["t"].max() * 1e-9


def test_clouds_with_any_fields_are_read_as_they_were() -> None:
    points = ground(np.random.default_rng(0))
    times = {
        "time": np.linspace(-0.1, 0.0, len(points)).astype(np.float32),
        "timestamp": 1e9 + np.arange(len(points), dtype=np.float64),
    }
    cloud = decode_cloud(encode_points(points, T0, "os.lidar", times), max_message=1 << 20, max_points=1 << 20)
    assert (cloud.frame_id, cloud.stamp_ns) == ("os.lidar", T0)
    assert np.array_equal(cloud.points, points)
    for name, values in times.items():
        assert np.array_equal(cloud.time_values(name), values)


def test_who_did_not_name_a_fault_or_late_or_blamed_another_is_found() -> None:
    walk = draw("covariance_wide", 1)
    walk.told = Told(log=1.0, health=2.0, doctor=7.0, ended=1.0)
    assert findings([walk], 10.0) == []
    assert cell(walk, "doctor", 10.0) == "yes 7.0 s"
    walk.told.doctor, walk.told.health = None, 11.0
    walk.told.wrong.append("another is blamed")
    assert [line.split(": ")[1].split(";")[0] for line in findings([walk], 10.0)] == [
        "health LATE 11.0 s", "doctor NO", "another is blamed",
    ]  # fmt: skip
    assert "NO" in table([walk], 10.0)
    walk.told.said["pasted"] = "no cloud"
    assert cell(walk, "pasted", 10.0) == "NO"


def test_each_robot_walks_once_and_doctor_sees_those_begin_that_it_must() -> None:
    walks = [draw(name, 1) for name in FAULTS]
    found = batches(walks)
    assert sorted(walk.name for batch in found for walk in batch) == sorted(FAULTS)
    assert all(len(batch) <= TOGETHER for batch in found)
    assert all(len({walk.kind.begins == "meanwhile" for walk in batch}) == 1 for batch in found)


def test_a_wrong_time_offset_is_not_the_right_advice() -> None:
    names = draw("sensor_ahead", 1).fault.names
    assert named(names, "time_offset", "set time_offset = -37.0 in [sensors.rear]")
    assert not named(names, "time_offset", "set time_offset = 37.0 in [sensors.rear]")
    assert not named(names, "time_offset", "synchronise the clocks")


def test_pasted_settings_lie_over_the_others_and_odd_names_are_quoted() -> None:
    base = {"sensors": {"os.lidar": {"range_sigma": 0.1}}, "map": {"cell_size": 0.1}}
    both = merged(quoted(base), quoted({"sensors": {"os.lidar": {"time_offset": -37.0}, "rear": {}}}))
    assert both == {
        "sensors": {'"os.lidar"': {"range_sigma": 0.1, "time_offset": -37.0}, "rear": {}}, "map": {"cell_size": 0.1},
    }  # fmt: skip
    assert quoted(both) == both


def test_the_command_ends_with_1_by_what_it_finds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    import importlib.util  # the trials' programs have one name

    spec = importlib.util.spec_from_file_location("walks_run", Path(__file__).with_name("run.py"))
    assert spec is not None
    assert spec.loader is not None
    program = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(program)
    out = tmp_path / "walks.json"
    monkeypatch.setattr(sys, "argv", ["run.py", "--seed", "4", "--only", "leap", "--json", str(out)])
    for log, code in ((0.1, 0), (None, 1)):

        def walk(folder: Path, walks: list, limit: float, say: object, log: float | None = log) -> None:
            walks[0].told.log, walks[0].told.doctor = log, 5.0
            walks[0].told.health = walks[0].told.ended = 0.2

        monkeypatch.setattr(program, "walk_all", walk)
        assert program.main() == code
        assert ("FOUND leap" in capsys.readouterr().out) == bool(code)
        assert bool(json.loads(out.read_text())["found"]) == bool(code)


def test_reliability_tells_of_each_fault_who_names_it() -> None:
    text = RELIABILITY.read_text(encoding="utf-8")
    head = r"^\| what is wrong \| log \| health \| doctor \|\n\|[-|]+\n"
    (rows,) = re.findall(head + r"((?:\|.*\n)+)", text, re.MULTILINE)
    told = {line.split("|")[1].strip(): [part.strip() for part in line.split("|")[2:5]] for line in rows.splitlines()}
    assert set(told) == {kind.title for name, kind in FAULTS.items() if name != "none"}
    for name, kind in FAULTS.items():
        if name == "none":
            continue
        names = draw(name, 1).fault.names
        log, health, doctor = told[kind.title]
        assert log != "-", name
        assert health.startswith("recently: ") != names.lasting, name
        assert doctor == {"ok": "told", "note": "a note", "wrong": "wrong"}[names.verdict], name
