"""Answers of a map of the ground, and of one of all points: their layers and limits, over real sessions."""

from collections.abc import Iterator

import numpy as np
import pytest
from asking_raw import RawTile, get
from served import T0, S, Served

from roughmap_schemas.layers import DEFAULT_LIMITS, LAYERS, layers_of

RNG = np.random.default_rng(11)
X, Y = (grid.ravel() for grid in np.meshgrid(np.arange(-8.0, 8.0, 0.04), np.arange(-5.0, 5.0, 0.04)))
GROUND = np.column_stack((X, Y, 0.1 * X + 0.05 * np.sin(3 * Y) + 0.25 * (Y > 3.0) + RNG.normal(0.0, 0.01, X.size)))
BOX = GROUND[(abs(X - 2.0) < 0.3) & (abs(Y) < 0.3)] + (0.0, 0.0, 0.8)
ROOF = GROUND[(X < -4.0) & (abs(Y) < 2.0)] + (0.0, 0.0, 2.2)
AREA = "-7.5,-4.5,7.5,4.5"


def served_with(surface: str) -> Iterator[Served]:
    with Served({"map": {"surface": surface, "levels": 4}}) as served:
        with served.view.change() as rough_map:
            rough_map.reset()
            for n, part in enumerate((GROUND, GROUND, GROUND, BOX, BOX, ROOF)):
                rough_map.add(part, S, T0 + n * 10**9, common=1e-4)
        yield served


@pytest.fixture(scope="module")
def ground() -> Iterator[Served]:
    yield from served_with("ground")


@pytest.fixture(scope="module")
def every_point() -> Iterator[Served]:
    yield from served_with("all")


def region(served: Served, parameters: str) -> RawTile:
    (sample,) = get(served.asker, f"maps/site/region?bbox={AREA};{parameters}").ok
    return RawTile(sample)


@pytest.mark.parametrize("level", [0, 2])
def test_all_layers_are_the_maps_own(ground: Served, level: int) -> None:
    found = region(ground, f"level={level};layers={','.join(LAYERS)}")
    box = [float(one) for one in AREA.split(",")]
    own = ground.map.region(box, LAYERS, level=level, limits=DEFAULT_LIMITS["ground"])
    layers = found.layers()
    assert list(layers) == list(LAYERS)
    for name in LAYERS:
        expected = own[name].astype("f4")
        assert np.array_equal(layers[name], expected, equal_nan=True), name
        assert np.isfinite(expected).any(), name
    assert found.info["surface"] == "ground"


def test_what_stands_is_an_obstacle_and_what_hangs_high_is_not(ground: Served, every_point: Served) -> None:
    layers = region(ground, "layers=obstacle,traversability,overhang_low,mean_height").layers()
    row, column = 45, 95  # (2, 0)
    assert layers["obstacle"][row, column] == 1.0
    assert layers["traversability"][row, column] == 0.0
    assert layers["mean_height"][row, column] == pytest.approx(0.2, abs=0.05)
    row, column = 45, 20  # (-5.5, 0), below the roof
    assert layers["obstacle"][row, column] == 0.0
    assert layers["traversability"][row, column] > 0.0
    assert layers["overhang_low"][row, column] == pytest.approx(2.2, abs=0.1)
    mixed = region(every_point, "layers=mean_height,range").layers()
    assert mixed["range"][row, column] > 2.0


def test_a_limit_alone_is_over_the_maps(ground: Served) -> None:
    """The others stay, clearance too; and an answer for other limits is drawn anew."""
    asked = "layers=traversability,obstacle"
    before = region(ground, asked).layers()
    higher = region(ground, f"{asked};limits=clearance:2.5").layers()
    assert np.nansum(higher["obstacle"]) > np.nansum(before["obstacle"]), "the roof is too low now"
    steep = region(ground, f"{asked};limits=slope:0.05").layers()
    assert np.array_equal(steep["obstacle"], before["obstacle"], equal_nan=True)
    assert np.nansum(steep["traversability"] > 0) < np.nansum(before["traversability"] > 0)
    again = region(ground, asked).layers()
    assert np.array_equal(again["traversability"], before["traversability"], equal_nan=True)


@pytest.mark.parametrize(
    ("surface", "parameters", "code"),
    [
        ("ground", "limits=std_dev:0.1", "bad_parameter"),
        ("ground", "limits=slope:0.4,range:0.1", "bad_parameter"),
        ("ground", "limits=clearance:2.6", "bad_parameter"),
        ("all", "limits=roughness:0.1", "bad_parameter"),
        ("all", "limits=clearance:1.0", "bad_parameter"),
        ("all", "layers=roughness", "unknown_layer"),
        ("all", "layers=mean_height,passable_share", "unknown_layer"),
    ],
)
def test_what_the_other_surface_has_is_refused(
    ground: Served, every_point: Served, surface: str, parameters: str, code: str
) -> None:
    served = ground if surface == "ground" else every_point
    for selector in (f"tiles/0/*/*?{parameters}", f"region?bbox=0,0,1,1;{parameters}", f"cells?x=0;y=0;{parameters}"):
        assert get(served.asker, f"maps/site/{selector}").error() == code, selector


def test_a_refused_limit_is_explained(ground: Served) -> None:
    (error,) = get(ground.asker, "maps/site/region?bbox=0,0,1,1;limits=std_dev:0.1").errors
    assert error["message"] == (
        "limits: 'std_dev' is a limit of maps whose surface is 'all'; this one's is 'ground', with the limits slope, "
        "step, roughness, confidence, clearance"
    )


def test_the_status_says_which_layers_there_are(ground: Served, every_point: Served) -> None:
    for served, surface in ((ground, "ground"), (every_point, "all")):
        status = get(served.asker, "maps/site/status").json()
        assert (status["surface"], tuple(status["layers"])) == (surface, layers_of(surface))


def test_a_map_of_all_points_has_confidences_too(every_point: Served) -> None:
    layers = region(every_point, "layers=confidence,mean_sigma,count").layers()
    known = layers["count"] > 0
    assert np.isfinite(layers["confidence"][known]).all()
    assert (layers["mean_sigma"][known] >= 0.009).all(), "no surer than the poses, with 1 cm"
