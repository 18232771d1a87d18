"""What a planner reads from recorded scans is right, figure by figure, as `make map-right` measures it.

A floor that is flat must be free, at its height, with whatever hangs over it; what stands on it must not; where a robot
has driven, it must be let drive; strays and people that left must cost next to nothing.
"""

from pathlib import Path

import pytest
import right_hall
import right_offroad
import right_person
import right_strays
from right_hall import Truth
from right_maps import SURFACES
from right_recordings import Hall, Offroad, hall, offroad
from right_row import Row

from roughmap import Limits
from roughmap.points.footprint import ERROR_MODELS


@pytest.fixture(scope="module")
def walk(recordings: Path) -> Hall:
    return hall(recordings)


@pytest.fixture(scope="module")
def true(walk: Hall) -> Truth:
    return right_hall.truth(walk)


@pytest.fixture(scope="module")
def path(recordings: Path) -> Offroad:
    return offroad(recordings)


def judged(rows: list[Row]) -> None:
    assert any(row.met is not None for row in rows)
    assert [row for row in rows if row.met is False] == []


def test_the_truth_has_cells_to_judge_by(true: Truth) -> None:
    assert true.open.sum() > 12_000
    assert true.obstacle.sum() > 1_800


@pytest.mark.parametrize("model", ERROR_MODELS)
def test_the_halls_floor(walk: Hall, true: Truth, model: str) -> None:
    before, after = ({model: right_hall.read(surface, walk.sweeps(), model)} for surface in SURFACES)
    judged(right_hall.rows(walk, before, after, true))
    assert right_hall.forbidden(before[model], true) > 40.0, "the paper's method is what it was"


@pytest.mark.parametrize("model", ERROR_MODELS)
def test_the_driven_track(path: Offroad, model: str) -> None:
    before, after = ({model: right_offroad.read(surface, path, model)} for surface in SURFACES)
    judged(right_offroad.rows(path, before, after))


def test_strays(walk: Hall, true: Truth) -> None:
    clean = {surface: right_hall.read(surface, walk.sweeps(), "cuboid") for surface in SURFACES}
    judged(right_strays.hall_rows(walk, clean, true, 1, "cuboid"))


def test_people_who_left(walk: Hall, true: Truth) -> None:
    """A little more than `make map-right` finds may be left; tests/map_right/README.md says why any is."""
    stood = right_person.Case(0.0, True, 1, 2)
    walked = right_person.Case(0.5, False, 1, 2)
    declared = Limits(fov=right_person.FIELD)
    assert right_person.blocked("all", walk, true, stood, "cuboid", Limits()).share > 80.0
    assert right_person.blocked("ground", walk, true, stood, "cuboid", Limits()).share < 20.0
    assert right_person.blocked("ground", walk, true, walked, "cuboid", declared).share < 3.0
