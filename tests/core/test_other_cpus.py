"""One digest per architecture, for any CPU extensions, any variants of C library functions and any threads.

The bits of a cell are the same on x86-64 and ARM because no kernel leaves the compiler a choice: its IR is read.
"""

import json
import os
import platform
import subprocess
import sys
from types import ModuleType
from typing import Any

import digest_program
import ir_program
import pytest

HIDDEN = "glibc.cpu.hwcaps=" + ",".join(
    f"-{name}"
    for name in ("AVX512F", "AVX512VL", "AVX512DQ", "AVX512BW", "AVX2", "AVX", "FMA", "FMA4", "ERMS", "BMI2", "SSE4_1")
)
"""Selects the function variants of glibc. Other C libraries ignore it."""

GENERIC = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
"""Kernels for the baseline of the architecture: on x86-64 no AVX and no FMA."""


@pytest.fixture(scope="module")
def here() -> dict[str, str]:
    return digest_program.digests()


def elsewhere(program: ModuleType, **environment: str) -> dict[str, Any]:
    """Run a program in a process of its own and return its output."""
    made = subprocess.run(
        [sys.executable, str(program.__file__)],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=1100,
        check=False,
    )
    assert made.returncode == 0, made.stderr
    said: dict[str, Any] = json.loads(made.stdout)
    return said


@pytest.fixture(scope="module")
def compiled() -> dict[str, Any]:
    """All kernels, compiled again for the baseline, with the C library's simplest function variants."""
    return elsewhere(ir_program, GLIBC_TUNABLES=HIDDEN, **GENERIC)


@pytest.mark.timeout(1200)
def test_no_instruction_of_any_kernel_may_be_rounded_otherwise(compiled: dict[str, Any]) -> None:
    """Neither `fast`, `contract` and their like, nor fused products, nor a function of the C library but `sqrt`.

    The oracle alone takes `erf` from there. This is first, so that while it runs, others fill the cache for the rest.
    """
    assert compiled["arithmetic"] > 500
    assert compiled["loose"] == []
    assert compiled["fused"] == []
    assert not [name for name in compiled["c_library"] if not name.startswith("reference: ")]
    assert compiled["not_compiled"] == [], "ir_program.exercise() must call these"


def test_methods_and_models_differ(here: dict[str, str]) -> None:
    """The digests distinguish maps: eighteen runs give nine maps, each with one thread and with two."""
    assert len(here) == 18
    assert len(set(here.values())) == 9
    for name, digest in here.items():
        assert here[name[:-1] + "1"] == digest


def test_the_digests_are_those_of_every_other_machine(here: dict[str, str]) -> None:
    """x86-64 and ARM give the same; `digest_program.py --keep` writes the file after a change of what cells hold."""
    kept = json.loads(digest_program.KEPT.read_text())
    assert {name[: -len(", 1")]: digest for name, digest in here.items() if name.endswith("1")} == kept


@pytest.mark.skipif(platform.machine() != "x86_64", reason="hides extensions of x86-64")
@pytest.mark.timeout(1200)
def test_without_avx_and_fma(here: dict[str, str], compiled: dict[str, Any]) -> None:
    """Neither in the kernels, which are compiled again, nor in the C library."""
    assert compiled["cpu"] == "generic"
    assert "+avx" not in compiled["features"]
    assert "+fma" not in compiled["features"]
    assert compiled["digests"] == here


@pytest.mark.skipif(platform.machine() != "x86_64", reason="hides extensions of x86-64")
def test_another_variant_of_the_c_library(here: dict[str, str]) -> None:
    """The same compiled kernels with the C library's simplest function variants."""
    assert elsewhere(digest_program, GLIBC_TUNABLES=HIDDEN)["digests"] == here
