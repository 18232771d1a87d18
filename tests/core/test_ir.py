"""The bits of a cell are the same on x86-64 and ARM because no kernel leaves the compiler a choice: its IR is read."""

import json
import os
import subprocess
import sys
from pathlib import Path

import ir_program
import numba
import pytest


@pytest.mark.timeout(1200)
def test_no_instruction_of_any_kernel_may_be_rounded_otherwise() -> None:
    """Neither `fast`, `contract` and their like, nor fused products, nor a function of the C library but `sqrt`.

    The oracle alone takes `erf` from there.
    """
    made = subprocess.run(
        [sys.executable, str(Path(ir_program.__file__))],
        env={**os.environ, "NUMBA_OPT": "0"},
        capture_output=True,
        text=True,
        timeout=1100,
        check=False,
    )
    assert made.returncode == 0, made.stderr
    found = json.loads(made.stdout)
    assert found["arithmetic"] > 500
    assert found["loose"] == []
    assert found["fused"] == []
    assert not [name for name in found["c_library"] if not name.startswith("reference: ")]
    assert found["not_compiled"] == [], "ir_program.exercise() must call these"


def test_what_is_looked_for_is_found() -> None:
    """A function that is compiled with `fastmath`, and one with `contract` alone, that fuses and calls atan2."""

    def product(x: float, y: float, z: float) -> float:
        return x * y + z

    for flags in (True, {"contract"}, {"nnan", "nsz"}):
        text = numba.njit("f8(f8, f8, f8)", fastmath=flags)(product).inspect_llvm()
        assert ir_program.LOOSE.search(next(iter(text.values())))
    exact = next(iter(numba.njit("f8(f8, f8, f8)")(product).inspect_llvm().values()))
    assert not ir_program.LOOSE.search(exact)
    assert ir_program.FUSED.search("%.5 = call double @llvm.fma.f64(double %x, double %y, double %z)")
    assert ir_program.FUSED.search("%.5 = call double @llvm.fmuladd.f64(double %x, double %y, double %z)")
    assert ir_program.C_LIBRARY.search('%.5 = call double @"llvm.sin.f64"(double %x)')
    assert ir_program.C_LIBRARY.search("%.5 = call double @atan2(double %x, double %y)")
    assert not ir_program.C_LIBRARY.search("%.5 = call double @llvm.sqrt.f64(double %x)")
