"""Invalid arguments raise ValueError that names what was expected, and change nothing."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from strategies import SECOND_NS, state_of

from roughmap import CELL_DTYPE, Limits, Noise, RoughMap, Scan, Trajectory
from roughmap.cell import TRUST_DTYPE
from roughmap.tiles.state import TileState

END_NS = 2**32 * SECOND_NS
S = np.eye(3) * 1e-4
ONE = [(0.0, 0.0, 0.0)]


@pytest.fixture
def m() -> RoughMap:
    """Return a map that is not empty, so that a change would show."""
    m = RoughMap(threads=1)
    m.add([(0.07, -0.01, 1.0), (9.0, 3.0, 2.0)], S, stamp_ns=5 * SECOND_NS)
    return m


BAD_ADDS: dict[str, tuple[Callable[[RoughMap], Any], str]] = {
    "a point is not a row": (lambda m: m.add((0.0, 0.0, 0.0), S), r"points: expected .*\(N, 3\)"),
    "two columns": (lambda m: m.add([(0.0, 0.0)], S), r"points: expected .*\(N, 3\)"),
    "words": (lambda m: m.add([("a", "b", "c")], S), r"points: expected numbers"),
    "complex": (lambda m: m.add(np.zeros((1, 3), complex), S), r"points: expected numbers"),
    "flags": (lambda m: m.add(np.zeros((1, 3), bool), S), r"points: expected numbers"),
    "objects": (lambda m: m.add(np.zeros((1, 3), object), S), r"points: expected numbers"),
    "no covariance": (lambda m: m.add(ONE), r"covariance: expected \(N, 3, 3\)"),
    "no covariance for nothing": (lambda m: m.add(np.zeros((0, 3))), r"covariance: expected \(N, 3, 3\)"),
    "a covariance too few": (lambda m: m.add(ONE * 2, [S]), r"covariance: expected .*\(2, 3, 3\)"),
    "six numbers": (lambda m: m.add(ONE, np.zeros((1, 6))), r"covariance: expected"),
    "a covariance of words": (lambda m: m.add(ONE, np.full((3, 3), "a")), r"covariance: expected numbers"),
    "before 1970": (lambda m: m.add(ONE, S, -1), r"stamp_ns: expected .*\[0, 2\^32 s\)"),
    "after 2106": (lambda m: m.add(ONE, S, END_NS), r"stamp_ns: expected .*\[0, 2\^32 s\)"),
    "beyond 64 bits": (lambda m: m.add(ONE, S, 2**70), r"stamp_ns: expected"),
    "one of the stamps": (lambda m: m.add(ONE * 2, S, [0, END_NS]), r"stamp_ns: expected"),
    "one of the stamps before": (lambda m: m.add(ONE * 2, S, [-1, 0]), r"stamp_ns: expected"),
    "one of the stamps unsigned": (
        lambda m: m.add(ONE * 2, S, np.array([0, 2**64 - 1], np.uint64)),
        r"stamp_ns: expected",
    ),
    "seconds": (lambda m: m.add(ONE, S, 1.5), r"stamp_ns: expected an integer"),
    "stamps in seconds": (lambda m: m.add(ONE, S, [1.5]), r"stamp_ns: expected integers"),
    "a stamp too many": (lambda m: m.add(ONE, S, [1, 2]), r"stamp_ns: expected integers"),
    "an offset too many": (lambda m: m.add(ONE, S, 0, offsets_ns=[1, 2]), r"offsets_ns: expected integers"),
    "offsets in seconds": (lambda m: m.add(ONE, S, 0, offsets_ns=[0.5]), r"offsets_ns: expected integers"),
}


@pytest.mark.parametrize("name", BAD_ADDS)
def test_add(m: RoughMap, name: str) -> None:
    call, message = BAD_ADDS[name]
    before = state_of(m)
    with pytest.raises(ValueError, match=message):
        call(m)
    assert state_of(m) == before


ONES = TileState(np.ones(4096, CELL_DTYPE), np.ones(4096, TRUST_DTYPE), None)

SINCE: dict[str, Callable[[RoughMap], Any]] = {
    "done already": lambda m: m.add(ONE, S),
    "another prepared": lambda m: m.prepare_points(ONE, S),
    "emptied": lambda m: m.reset(),
    "a tile loaded": lambda m: m.load_tile(50, 50, ONES, 0, 0),
}


@pytest.mark.parametrize("name", SINCE)
def test_points_prepared_for_another_state(m: RoughMap, name: str) -> None:
    prepared = m.prepare_points(ONE * 2, S)
    SINCE[name](m)
    before = state_of(m)
    with pytest.raises(ValueError, match="expected the points prepared last"):
        m.integrate(prepared)
    assert state_of(m) == before


BOX = (0.0, 0.0, 1.0, 1.0)
BAD_REGIONS: dict[str, tuple[tuple[Any, ...], dict[str, Any], str]] = {
    "not finite": (((0.0, 0.0, np.nan, 1.0), ["range"]), {}, "finite"),
    "without end": (((0.0, 0.0, np.inf, 1.0), ["range"]), {}, "finite"),
    "empty": (((0.0, 0.0, 0.0, 1.0), ["range"]), {}, "empty"),
    "upside down": (((0.0, 1.0, 1.0, 0.0), ["range"]), {}, "empty"),
    "narrower than the slack": (((0.0, 0.0, 1e-9, 1.0), ["range"]), {}, "covers no cell: .* cells of 0.1 m"),
    "three numbers": (((0.0, 0.0, 1.0), ["range"]), {}, "four"),
    "more than 2^26 cells": (((0.0, 0.0, 819.2, 819.3), ["range"]), {}, "67108864"),
    "an unknown layer": ((BOX, ["height"]), {}, "height"),
    "level -1": ((BOX, ["range"]), {"level": -1}, "level"),
    "level 8 of 8": ((BOX, ["range"]), {"level": 8}, "level"),
    "level 1/2": ((BOX, ["range"]), {"level": 0.5}, "level"),
    "no tolerance": ((BOX, ["range"]), {"height_tolerance": 0.0}, "tolerance"),
    "an unknown limit": ((BOX, ["range"]), {"limits": {"height": 1.0}}, "height"),
}


@pytest.mark.parametrize("name", BAD_REGIONS)
def test_region(m: RoughMap, name: str) -> None:
    arguments, options, message = BAD_REGIONS[name]
    before = state_of(m)
    with pytest.raises(ValueError, match=message):
        m.region(*arguments, **options)
    assert state_of(m) == before


@pytest.mark.parametrize("level", [-1, 8, 0.5, "0"])
def test_freeze(m: RoughMap, level: Any) -> None:
    with pytest.raises(ValueError, match="level: expected an integer"):
        m.freeze(level)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cell_size": 0.0}, "cell_size"),
        ({"cell_size": -0.1}, "cell_size"),
        ({"cell_size": np.nan}, "cell_size"),
        ({"cell_size": np.inf}, "cell_size"),
        ({"cell_size": "0.1"}, "cell_size"),
        ({"error_model": "sphere"}, "error_model.*point, cuboid, ellipsoid"),
        ({"coverage": 0.0}, "coverage"),
        ({"min_radius": 0.0}, "min_radius"),
        ({"min_distance": 0.0}, "min_distance"),
        ({"min_share": -0.01}, "min_share"),
        ({"min_share": 1.01}, "min_share"),
        ({"min_share": np.nan}, "min_share"),
        ({"max_horizontal_radius": 0.0}, "max_horizontal_radius"),
        ({"max_horizontal_radius": 26.0}, "max_horizontal_radius.*256 cells"),
        ({"bounds": (0, 0, 1)}, "bounds"),
        ({"bounds": (0, 0, 0, 1)}, "bounds"),
        ({"bounds": (0, 0, 1, np.inf)}, "bounds"),
        ({"bounds": 7}, "bounds"),
        ({"levels": 0}, "levels"),
        ({"levels": 27}, "levels"),
        ({"levels": 2.0}, "levels"),
        ({"threads": 0}, "threads"),
        ({"threads": 1.0}, "threads"),
    ],
)
def test_invalid_settings(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RoughMap(**options)


UNIT = (0.0, 0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Scan([(0.0, 0.0)], 0), r"Scan\.points: .*\(N, 3\)"),
        (lambda: Scan(ONE, -1), r"Scan\.stamp_ns"),
        (lambda: Scan(ONE, END_NS), r"Scan\.stamp_ns"),
        (lambda: Scan(ONE, 0.5), r"Scan\.stamp_ns: expected an integer"),
        (lambda: Scan(ONE, 0, [0, 1]), r"Scan\.offsets_ns"),
        (lambda: Scan(ONE, 0, [0.5]), r"Scan\.offsets_ns"),
        (lambda: Scan(ONE, 0, translation=(0, 0)), r"Scan\.translation: .*\(3,\)"),
        (lambda: Scan(ONE, 0, translation=(0, 0, np.nan)), r"Scan\.translation: .*finite"),
        (lambda: Scan(ONE, 0, rotation=(0, 0, 0)), r"Scan\.rotation: .*\(4,\)"),
        (lambda: Scan(ONE, 0, rotation=(0, 0, np.inf, 0)), r"Scan\.rotation: .*finite"),
        (lambda: Trajectory([], np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 6, 6))), "at least one"),
        (lambda: Trajectory([1, 1], np.zeros((2, 3)), [UNIT] * 2, np.zeros((2, 6, 6))), "strictly increasing"),
        (lambda: Trajectory([1, 0], np.zeros((2, 3)), [UNIT] * 2, np.zeros((2, 6, 6))), "strictly increasing"),
        (lambda: Trajectory([0.5], np.zeros((1, 3)), [UNIT], np.zeros((1, 6, 6))), r"Trajectory\.stamp_ns"),
        (lambda: Trajectory([-(2**63), 2**63 - 1], np.zeros((2, 3)), [UNIT] * 2, np.zeros((2, 6, 6))), r"2\^62"),
        (lambda: Trajectory([0], np.zeros((2, 3)), [UNIT], np.zeros((1, 6, 6))), r"Trajectory\.position"),
        (lambda: Trajectory([0], [(0, 0, np.nan)], [UNIT], np.zeros((1, 6, 6))), r"Trajectory\.position"),
        (lambda: Trajectory([0], [(0, 0, 0)], [UNIT], np.zeros((6, 6))), r"Trajectory\.covariance"),
        (lambda: Trajectory([0], [(0, 0, 0)], [UNIT], np.full((1, 6, 6), np.nan)), r"Trajectory\.covariance"),
        (lambda: Noise(-0.01), r"Noise\.range_sigma"),
        (lambda: Noise(np.nan), r"Noise\.range_sigma"),
        (lambda: Noise(np.inf), r"Noise\.range_sigma"),
        (lambda: Noise(0.01, beam_sigma=-1.0), r"Noise\.beam_sigma"),
        (lambda: Noise(0.01, range_sigma_per_m=-1.0), r"Noise\.range_sigma_per_m"),
        (lambda: Noise(0.01, range_sigma_per_m2=-1.0), r"Noise\.range_sigma_per_m2"),
        (lambda: Noise(0.01, mount_sigma=(0, 0, 0)), r"Noise\.mount_sigma"),
        (lambda: Noise(0.01, mount_sigma=(0, 0, 0, 0, 0, -1e-3)), r"Noise\.mount_sigma"),
        (lambda: Limits(min_range=-1.0), r"Limits\.min_range"),
        (lambda: Limits(max_range=np.nan), r"Limits\.max_range"),
        (lambda: Limits(ceiling=np.nan), r"Limits\.ceiling"),
        (lambda: Limits(ceiling_slope=np.inf), r"Limits\.ceiling_slope"),
        (lambda: Limits(exclude=((0, 0, 0, 1, 1),)), r"Limits\.exclude"),
        (lambda: Limits(exclude=((0, 0, 2, 1, 1, 1),)), r"Limits\.exclude: .*min <= max"),
    ],
)
def test_invalid_scans(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_empty_input_is_valid(m: RoughMap) -> None:
    """No points or no returns: an empty report and no new sequence."""
    before = state_of(m)
    for report in (
        m.add(np.zeros((0, 3)), S),
        m.add(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, np.int64)),
        m.add_scan(Scan(np.zeros((0, 3)), 0), Trajectory([0], [(0, 0, 0)], [UNIT], np.zeros((1, 6, 6))), Noise(0.1)),
    ):
        assert (report.accepted, report.rejected, report.tiles.shape) == (0, {}, (0, 2))
    assert state_of(m) == before
