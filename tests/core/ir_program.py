"""Compiles every kernel of the core, without the cache, and prints what its instructions may do to the bits.

A program, because no kernel may have been loaded before. It prints what `digest_program.py` prints, too: compiling is
what takes the time, so that it is run once for both, with kernels for another CPU.
"""

import importlib
import json
import pkgutil
import re
import sys

import digest_program
import numpy as np
from numba.core import config
from numba.core.codegen import CPUCodeLibrary
from numba.core.dispatcher import Dispatcher

import roughmap
from roughmap import RoughMap, georeference, jit
from roughmap.reading.cell_values import known_bits
from roughmap.reading.layers import layers_of
from roughmap.reference.error_function import erf
from roughmap.settings import SURFACES
from roughmap.tiles.index import rehash
from roughmap.tiles.slots import SlotPool

LOOSE = re.compile(
    r"\b(?:fadd|fsub|fmul|fdiv|frem|fneg|fcmp|call|select|phi)\s+"
    r"(?:(?:fast|contract|reassoc|nnan|ninf|nsz|arcp|afn)\s+)*(fast|contract|reassoc|nnan|ninf|nsz|arcp|afn)\s"
)
"""An instruction with a flag that allows other results than IEEE's."""

FUSED = re.compile(r"@\"?(llvm\.fma|llvm\.fmuladd|fmaf?\b)")

C_LIBRARY = re.compile(
    r"@\"?(?:llvm\.)?(a?sinh?|a?cosh?|a?tanh?|atan2|hypot|exp2?|expm1|log(?:2|10|1p)?|pow|cbrt|erfc?|l?gamma|fmod)"
    r"(?:f|\.f\d\d)?\"?\("
)

FUNCTION = re.compile(r"^define [^@]*@\"?_ZN8roughmap(\d+)(\w+)", re.MULTILINE)


def kernels() -> dict[str, Dispatcher]:
    """All kernels of the core by name, without the helpers that are compiled into them."""
    return {
        f"{module.name}.{name}": value
        for module in pkgutil.walk_packages(roughmap.__path__, "roughmap.")
        for name, value in vars(importlib.import_module(module.name)).items()
        if isinstance(value, Dispatcher)
        and value.__module__ == module.name
        and not value.targetoptions.get("forceinline")
    }


def exercise() -> None:
    """Call the kernels that no digest needs.

    Nobody looks at the machine code of these, and LLVM's passes never give an instruction a flag that it did not have.
    """
    config.OPT = 0
    georeference(*digest_program.scan_and_way(), digest_program.Noise(0.02))
    rehash(np.empty(2, np.int32), np.zeros(1, np.uint64), 0)
    erf(np.zeros(1))
    corner = np.array([[0.05, 0.05, 1.0], [0.05, 0.05, 2.0], [3.05, 3.05, 2.0]])
    for surface in SURFACES:
        with RoughMap(error_model="point", surface=surface) as m:
            m.add(corner)
            with m.freeze() as frozen:
                known_bits(frozen.records(0, 0))
                m.add(corner)  # on a copy of the tile
            for level in (0, 2):
                m.region((-1.0, -1.0, 4.0, 4.0), layers_of(surface), level=level)
            m.forget([(0, 0)])
    pool, dense = SlotPool(), np.ones(1, np.bool_)
    pool.release(pool.allocate(1, dense))
    slots = pool.allocate(1, dense)  # the same slot again, cleared
    pool.take_columns(slots)
    for _ in range(2):  # the second copy has the same column again, cleared
        pool.release(pool.duplicate(slots))


def room(text: str) -> str:
    """The room of the core in which the functions of a module of IR are; empty for numba's own."""
    found = FUNCTION.search(text)
    return found[2][: int(found[1])] if found else ""


def main() -> None:
    texts: list[str] = []
    add = CPUCodeLibrary.add_ir_module

    def kept(self: CPUCodeLibrary, module: object) -> None:
        texts.append(str(module))
        add(self, module)

    CPUCodeLibrary.add_ir_module = kept
    jit._PackageCache.load_overload = lambda *_: None  # type: ignore[assignment]
    jit._PackageCache.save_overload = lambda *_: None  # type: ignore[assignment]
    digests = digest_program.digests()
    exercise()
    whole = "\n".join(texts)
    json.dump(
        {
            **digest_program.machine(),
            "digests": digests,
            "arithmetic": len(re.findall(r"\bf(?:add|sub|mul|div)\b", whole)),
            "loose": sorted(set(LOOSE.findall(whole))),
            "fused": sorted(set(FUSED.findall(whole))),
            "c_library": sorted({f"{room(text)}: {name}" for text in texts for name in C_LIBRARY.findall(text)}),
            "not_compiled": sorted(name for name, kernel in kernels().items() if not kernel.signatures),
        },
        sys.stdout,
    )


if __name__ == "__main__":
    main()
