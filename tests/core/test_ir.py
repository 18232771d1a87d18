"""What `test_other_cpus.py` looks for in the IR of kernels is found where it is."""

import ir_program
import numba


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
