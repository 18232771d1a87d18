"""The doctor on sensors whose `exclude` boxes hold nearly all of their points."""

import numpy as np
import pytest
from service_tools import config

from roughmap_service.cli.doctor.clouds import judge_points
from roughmap_service.cli.doctor.heard import HeardSensor
from roughmap_service.cli.doctor.survey import SOME, survey

AHEAD = np.random.default_rng(0).uniform([1.0, -2.0, -1.0], [4.0, 2.0, 1.0], (2000, 3))
"""Points in front of a sensor, in its frame."""

TURNED = (0.0, 0.0, 1.0, 0.0)
"""The sensor looks backwards."""


@pytest.mark.parametrize(
    ("rotation", "box", "excluded"),
    [
        ((0, 0, 0, 1), [0, -3, -3, 6, 3, 3], True),
        ((0, 0, 0, 1), [0, -3, -3, 1, 3, 3], False),
        (TURNED, [0, -3, -3, 6, 3, 3], False),
        (TURNED, [-6, -3, -3, 0, 3, 3], True),
    ],
)
def test_the_boxes_are_in_the_robots_frame(rotation: tuple[float, ...], box: list[float], *, excluded: bool) -> None:
    sensor = HeardSensor()
    sensor.surveys.append(survey(AHEAD, 0.1))
    assert 0 < len(sensor.surveys[0].some) <= SOME
    table = {"range_sigma": 0.01, "rotation": rotation, "exclude": [box]}
    found = judge_points("r1", "lidar", sensor, config(sensors={"lidar": table}), ("sensors", "lidar"))
    texts = [(one.verdict, one.text, one.remedy) for one in found if "exclude" in one.text]
    assert bool(texts) == excluded
    if excluded:
        verdict, text, remedy = texts[0]
        assert verdict == "wrong"
        assert text.startswith("100 % of the points")
        assert "[sensors.lidar]" in str(remedy)
