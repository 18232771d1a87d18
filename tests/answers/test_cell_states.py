"""What a `cells` query says of a cell beside its record: its trust, and what is off its ground."""

import numpy as np
import pytest
from asking_raw import get
from served import T0, Served

FLOOR = np.column_stack([*(grid.ravel() for grid in np.meshgrid(np.arange(0.05, 6.0, 0.1), [3.05])), np.zeros(60)])
TREE = np.array([[3.05, 3.05, h] for h in (1.52, 1.53, 1.91)])
S = np.eye(3) * 1e-8


def asked(served: Served, x: float, layers: str = "mean_height") -> dict:
    (cell,) = get(served.asker, f"maps/site/cells?x={x};y=3.05;layers={layers}").json()["cells"]
    return cell


@pytest.mark.parametrize("surface", ["ground", "all"])
def test_what_stands_on_the_ground_is_told_beside_it(surface: str) -> None:
    with Served({"map": {"name": "site", "surface": surface}}) as served:
        with served.view.change() as rough_map:
            rough_map.reset()
            for n in range(4):
                rough_map.add(FLOOR, S, T0 + n * 10**9, common=0.0025)
            rough_map.add(TREE, S, T0 + 4 * 10**9, common=0.0025)
        free, tree = (asked(served, x)["state"] for x in (1.05, 3.05))
    assert (free["count"], free["mean"], free["off_ground"]) == (4, 0.0, [])
    for state in (free, tree):
        assert state["pose_variance"] == pytest.approx(0.0025)
        assert 0.0 < state["variance"] <= state["pose_variance"] * (1 + 1e-6)
        assert state["mount_sigma"] == 0.0
    if surface == "all":
        assert (tree["count"], tree["off_ground"]) == (7, [])
        return
    assert (tree["count"], tree["mean"], tree["max"]) == (4, 0.0, 0.0)
    assert tree["off_ground"] == [
        {"height": pytest.approx(1.525), "hits": 2},
        {"height": pytest.approx(1.925), "hits": 1},
    ]
