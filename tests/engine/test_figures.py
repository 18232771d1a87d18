"""The figures of lost clouds and poses: those of a run in which each was lost on purpose."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from service_tools import GROUND, LEVEL, SECOND, T0, LoggedRun, config

from roughmap_schemas import encode_cloud, encode_odometry
from roughmap_schemas.kinds import Kind
from roughmap_service.engine.figures import _reach
from roughmap_service.inputs.queue import InputMessage

FAR = np.random.default_rng(0).uniform(-180.0, 180.0, (3000, 3)) * [1.0, 1.0, 0.0] - [0.0, 0.0, 1.0]


def variances(*six: float) -> np.ndarray:
    return np.diag(np.array(six, np.float64))


def drive(
    run: LoggedRun,
    *,
    seconds: float = 2.0,
    covariance: np.ndarray | None = None,
    frame: str = "map",
    ahead: float = 0.0,
    points: np.ndarray = GROUND,
    cloud_frame: str = "lidar",
    pose_period: float = 0.02,
    leap: float = 0.0,
) -> str:
    """Drive at 50 poses and 10 clouds a second; return what is told of the run."""
    covariance = variances(1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6) if covariance is None else covariance
    for step in range(round(seconds * 50)):
        t = step * 0.02
        stamp = T0 + round(t * SECOND)
        if step % round(pose_period * 50) == 0:
            side = leap * ((step + 1) // 5 % 2)
            payload = encode_odometry(stamp, frame, (0.1 * t, side, 1.0), LEVEL, covariance)
            run.live.accept(InputMessage(Kind.ODOMETRY, "rover", payload, stamp, t), t)
        if step % 5 == 4:
            cloud = encode_cloud(points, stamp - SECOND // 100 + round(ahead * SECOND), cloud_frame)
            run.live.accept(InputMessage(Kind.POINTS, "rover", cloud, stamp, t), t)
        run.decide(t)
    return "\n".join(run.streams.problems().values())


CASES: dict[str, tuple[dict[str, Any], dict[str, Any], list[str]]] = {
    "pose covariance": (
        {}, {"covariance": variances(0.09, 0.09, 1e-4, 1e-5, 1e-5, 1e-5)},
        ["2 sigma = 0.60 m, map.max_horizontal_radius = 0.5; the pose covariance alone is larger",
         '([robots.rover] pose_covariance = "cap")'],
    ),
    "pose covariance, capped": (
        {"robots": {"rover": {"pose_covariance": "cap"}}, "input": {"pose_sigma": [1.0] * 6}},
        {"covariance": variances(0.09, 0.09, 1e-4, 1e-5, 1e-5, 1e-5)}, ["2 sigma = 0.60 m", "lower input.pose_sigma"],
    ),
    "height": (
        {}, {"covariance": variances(1e-4, 1e-4, 0.36, 1e-5, 1e-5, 1e-5)},
        ["sigma z = 0.60 m, map.max_vertical_sigma = 0.5", "pose_covariance"],
    ),
    "heading": (
        {}, {"covariance": variances(1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 0.25), "points": GROUND * [3.0, 1.0, 1.0]},
        ["beyond 0.5 m they are over map.max_horizontal_radius = 0.5: sigma of the heading is 0.5 rad",
         'pose_covariance = "cap"'],
    ),
    "the sensor's own": (
        {"sensors": {"lidar": {"range_sigma": 0.6}}}, {},
        ["2 sigma = 1.20 m with range_sigma and mount_sigma, map.max_horizontal_radius = 0.5",
         "check range_sigma, beam_sigma and mount_sigma in [sensors.lidar]"],
    ),
    "ahead": (
        {}, {"ahead": 37.0},
        ["the newest pose is 37.0 s behind",
         "check that lidar and odometry use one clock, or set time_offset = -37.0 in [sensors.lidar]"],
    ),
    "ahead a little": (
        {"sensors": {"os.lidar": {"range_sigma": 0.01}}}, {"ahead": 3.0, "cloud_frame": "os.lidar"},
        ['set time_offset = -3.0 in [sensors."os.lidar"]; raise input.max_wait if its poses come 3.0 s late'],
    ),
    "corrected by too much": (
        {"sensors": {"os.lidar": {"range_sigma": 0.01, "time_offset": 37.0}}}, {"cloud_frame": "os.lidar"},
        ["the newest pose is 37.0 s behind", 'set time_offset = 0.0 in [sensors."os.lidar"]'],
    ),
    "behind": (
        {}, {"ahead": -12.0},
        ["their stamps are 12.0 s behind the newest pose", "set time_offset = 12.0 in [sensors.lidar]"],
    ),
    "gaps": (
        {"input": {"max_wait": 4.0}}, {"pose_period": 0.6, "seconds": 8.0},
        ["two of them are 0.6 s apart", "input.max_pose_gap = 0.5 s"],
    ),
    "slow poses": (
        {}, {"pose_period": 0.6, "seconds": 4.0},
        ["the robot's poses are 0.6 s apart (input.max_pose_gap = 0.5)",
         "publish poses more often, or set max_pose_gap = 0.9 and max_wait = 0.9 in [input]"],
    ),
    "no frame": (
        {}, {"frame": "/map"},
        ['their frame is "/map"; no transform is known; write their frame as "map"', "see the line of robot rover"],
    ),
    "tiles": (
        {"map": {"cell_size": 0.02}}, {"points": FAR},
        ["points are up to 25", "4096 tiles (map.max_new_tiles) of 1.28 m cover 46 m", "max_range in [sensors.lidar]"],
    ),
    "tiles of the map": (
        {"map": {"cell_size": 0.02, "max_tiles": 1}}, {"points": FAR}, ["map.max_tiles"],
    ),
    "millimetres": (
        {"sensors": {"lidar": {"range_sigma": 0.01, "max_range": 100.0}}}, {"points": GROUND * 1000.0},
        ["half of them are within", "max_range = 100)", "in metres"],
    ),
    "bounds": (
        {"map": {"bounds": [100.0, 100.0, 200.0, 200.0]}}, {},
        ["the robot is at x = 0.", "map.bounds = [100.0, 100.0, 200.0, 200.0]"],
    ),
    "no such times": (
        {"sensors": {"lidar": {"range_sigma": 0.01, "time_field": "stamp"}}}, {},
        ["what the times of its points mean is unclear; no field stamp, but", "time_origin in [sensors.lidar]"],
    ),
    "leaps": ({}, {"leap": 2.5}, ["it moved 2.50 m in 0.02 s (input.max_leap = 0.3)"]),
    "placed": (
        {"input": {"placed_sigma": 1.0}}, {"cloud_frame": "map"},
        ["robot rover sensor map: 100 %", "lower input.placed_sigma"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_the_sentence_has_the_figures(name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    sections, fed, wanted = CASES[name]
    caplog.set_level(logging.WARNING)
    with LoggedRun(tmp_path / "log", config(**sections)) as run:
        told = drive(run, **fed)
    for text in wanted:
        assert text in told, told
    lines = [record.getMessage() for record in caplog.records if getattr(record, "event", "") == "stream_lost"]
    assert set(told.splitlines()) <= set(lines)


def test_a_good_run_has_nothing_told_of_it(tmp_path: Path) -> None:
    with LoggedRun(tmp_path / "log") as run:
        assert drive(run) == ""


@given(st.floats(0.0, 1e3), st.floats(0.0, 1e3), st.floats(0.0, 10.0))
@examples(100)
def test_the_reach_is_where_the_error_meets_the_limit(limit: float, sigma: float, angle: float) -> None:
    reach = _reach(limit, sigma, angle)
    assert reach >= 0.0
    if 0.0 < reach < 1e6:
        assert np.hypot(sigma, angle * reach) == pytest.approx(limit)


def test_unclear_times_are_told_once_beside_the_loss(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    with LoggedRun(tmp_path / "log", config(sensors={"lidar": {"range_sigma": 0.01, "time_field": "stamp"}})) as run:
        drive(run, seconds=4.0)
    events = [getattr(record, "event", "") for record in caplog.records]
    assert sorted(events) == ["stream_lost", "time_form"]
