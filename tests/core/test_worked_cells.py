"""The contract's worked cells, to the printed digits, through the running update and the layers."""

import numpy as np
import pytest
from strategies import MODELS, cells_of

from roughmap import RoughMap

POINTS = [(0.57, -0.22, 10.00), (0.56, -0.24, 10.03), (0.61, -0.25, 9.98)]
LONG = np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 0.0], [0.0, 0.0, 1.0]]) * 1e-4
COVARIANCE = np.stack([LONG, LONG, np.diag([1.0, 1.0, 4.0]) * 1e-4])

OTHERS = {"point": {(6, -3)}, "cuboid": {(6, -3), (5, -2), (6, -2)}, "ellipsoid": {(6, -3), (5, -2)}}

STATE_VALUES = {
    # count, weight, weight_sq, mean, m2, min, max, inv_cf
    "point": ("2", "2", "2", "10.015", "4.5e-4", "10.00", "10.03", "1004444.44444"),
    "cuboid": (
        "3", "4513.88888889", "15914351.8519", "10.0046153846", "2.09134615385", "9.98", "10.03", "1229233749.21",
    ),
    "ellipsoid": (
        "3", "4492.0263065", "14546203.1635", "10.0071248174", "1.95399911549", "9.98", "10.03", "1401979797.22",
    ),
}  # fmt: skip

LAYER_VALUES = {
    # std_dev, expected_count, confidence_level, confidence_factor
    "point": ("0.0212132034356", "2", "0.904419295454", "9.95575221239e-7"),
    "cuboid": ("0.0460023501162", "1.28030303030", "0.461390349327", "8.13514923946e-10"),
    "ellipsoid": ("0.0394773740989", "1.38718675324", "0.544249981940", "7.13277040073e-10"),
}

STATE_NAMES = ("count", "weight", "weight_sq", "mean", "m2", "min", "max", "inv_cf")
LAYER_NAMES = ("std_dev", "expected_count", "confidence_level", "confidence_factor")


ERF_OFF = 1e-10
"""The largest error of the layers' own error function."""


def says(value: float, printed: str, off: float = 0.0) -> bool:
    """Whether ``value`` equals ``printed`` within half a unit of its last digit and ``off``; a short number is exact.

    Exact ones get 1e-11 of their size: m2 is a sum of squares of differences of heights near 10, whose rounding of
    1e-15 is 1e-13 of a difference of 0.01.
    """
    digits = printed.split("e", maxsplit=1)[0].replace(".", "").lstrip("0")
    if len(digits) < 9:
        return bool(abs(value - float(printed)) <= 1e-11 * abs(float(printed)))
    mantissa, _, exponent = printed.partition("e")
    unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    return bool(abs(value - float(printed)) <= 0.5000001 * unit + off)


def built(model: str) -> RoughMap:
    m = RoughMap(cell_size=0.1, coverage=2.0, error_model=model, surface="all", threads=1)
    report = m.add(POINTS, None if model == "point" else COVARIANCE)
    assert (report.accepted, report.rejected) == (3, {})
    return m


@pytest.mark.parametrize("model", MODELS)
def test_the_state(model: str) -> None:
    cells = cells_of(built(model))
    assert set(cells) == {(5, -3)} | OTHERS[model]
    for name, printed in zip(STATE_NAMES, STATE_VALUES[model], strict=True):
        assert says(float(cells[5, -3][name]), printed), (name, cells[5, -3][name], printed)


@pytest.mark.parametrize("model", MODELS)
def test_the_layers(model: str) -> None:
    # The middle of the cell, so that rounding of its edges does not matter.
    r = built(model).region((0.51, -0.29, 0.59, -0.21), LAYER_NAMES, height_tolerance=0.05)
    assert r.cells == (5, -3, 6, -2)
    for name, printed in zip(LAYER_NAMES, LAYER_VALUES[model], strict=True):
        off = ERF_OFF if name == "confidence_level" else 0.0
        assert says(r[name][0, 0], printed, off), (name, r[name][0, 0], printed)


@pytest.mark.parametrize("model", MODELS)
def test_one_by_one_gives_the_same_bytes(model: str) -> None:
    m = RoughMap(cell_size=0.1, coverage=2.0, error_model=model, surface="all", threads=1)
    for point, S in zip(POINTS, COVARIANCE, strict=True):
        m.add([point], S)
    assert m.digest() == built(model).digest()
