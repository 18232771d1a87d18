"""A real survey in UTM coordinates, through both methods of building the map."""

from pathlib import Path

import laspy
import numpy as np
import pytest
from two_methods import compare

from roughmap.map import RoughMap
from roughmap.points.footprint import ERROR_MODELS
from roughmap.reference.batch import BatchMap


@pytest.fixture(scope="module")
def survey(recordings: Path) -> np.ndarray:
    return np.ascontiguousarray(laspy.read(recordings / "lone-star.laz").xyz)


@pytest.mark.parametrize("model", ERROR_MODELS)
def test_the_survey_by_both_methods(survey: np.ndarray, model: str) -> None:
    """Broken ground at coordinates of several 10^5 and 10^6 m, with tilted errors of a few centimetres."""
    assert len(survey) == 518_862
    assert np.abs(survey[:, :2]).max() > 1e5
    S = np.array([[4.0, 1.0, 1.0], [1.0, 9.0, -1.0], [1.0, -1.0, 4.0]]) * 1e-4
    m = RoughMap(cell_size=0.1, error_model=model, surface="all")
    for begin in range(0, len(survey), 100_000):
        m.add(survey[begin : begin + 100_000], S, stamp_ns=begin * 10**6)
    stamps = np.arange(len(survey)) // 100_000 * 100_000 * 10**6
    b = BatchMap(survey, S, stamps, cell_size=0.1, error_model=model)
    assert b.accepted == len(survey)
    compare(m, b, np.abs(survey[:, 2]).max())
