"""What a run decides is the same on every machine: its rules call no function of the C library but `sqrt`."""

import ast
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap_service import run
from roughmap_service.run.pose_algebra import angle_between, distance, rotation_vector

EXACT = {"sqrt", "floor", "ceil", "isfinite", "isnan", "isinf", "inf", "nan", "pi"}
"""What IEEE 754 defines to the last bit, and constants."""

INEXACT = {
    "arccos", "arcsin", "arctan", "arctan2", "cbrt", "cos", "cosh", "einsum", "exp", "exp2", "expm1", "hypot",
    "linalg", "log", "log10", "log1p", "log2", "power", "sin", "sinh", "tan", "tanh",
}  # fmt: skip
"""Functions of numpy that call the C library or choose their code by CPU."""

MODULES = sorted(Path(run.__file__).parent.glob("*.py"))

UNIT = st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: sum(v * v for v in q) > 0.01)


@pytest.mark.parametrize("path", MODULES, ids=[path.stem for path in MODULES])
def test_no_rule_calls_the_c_library(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.module not in ("math", "cmath"), f"line {node.lineno}: import math, not from it"
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            name = f"{node.value.id}.{node.attr}, line {node.lineno}"
            assert node.value.id != "math" or node.attr in EXACT, name
            assert node.value.id != "np" or node.attr not in INEXACT, name
        assert not (isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow)), f"line {node.lineno}: x * x"
        assert not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "pow")


def unit(q: tuple[float, ...]) -> tuple[float, float, float, float]:
    n = math.hypot(*q)
    x, y, z, w = (v / n for v in q)
    return x, y, z, w


@examples(200)
@given(UNIT, UNIT)
def test_the_angle_between_rotations_is_that_of_the_c_library(a: tuple[float, ...], b: tuple[float, ...]) -> None:
    """1e-15 rad: both round a few times."""
    a, b = unit(a), unit(b)
    near, far = math.dist(a, b), math.dist(a, [-v for v in b])
    assert angle_between(a, b) == pytest.approx(4.0 * math.atan2(min(near, far), max(near, far)), rel=2e-15, abs=1e-15)
    # The vector is as long as the angle. Products of unit quaternions are off by 1e-16 each.
    assert distance((0.0, 0.0, 0.0), rotation_vector(a, b)) == pytest.approx(angle_between(a, b), rel=1e-14, abs=1e-14)


@examples(200)
@given(st.lists(st.tuples(*[st.floats(-1e12, 1e12)] * 2), min_size=3, max_size=3))
def test_a_distance_is_that_of_the_c_library(rows: list[tuple[float, float]]) -> None:
    a, b = zip(*rows, strict=True)
    assert distance(a, b) == pytest.approx(math.dist(a, b), rel=1e-15, abs=1e-150)


def test_a_distance_that_overflows_is_infinite() -> None:
    assert distance((1e308, 0.0, 0.0), (-1e308, 0.0, 0.0)) == math.inf
