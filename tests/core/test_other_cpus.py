"""One digest per architecture, for any CPU extensions, any variants of C library functions and any threads."""

import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import digest_program
import pytest

PROGRAM = Path(digest_program.__file__)

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


def elsewhere(**environment: str) -> dict[str, object]:
    """Run the program in a process of its own and return its output."""
    made = subprocess.run(
        [sys.executable, str(PROGRAM)],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=580,
        check=False,
    )
    assert made.returncode == 0, made.stderr
    said: dict[str, object] = json.loads(made.stdout)
    return said


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
@pytest.mark.timeout(600)
def test_without_avx_and_fma(here: dict[str, str], tmp_path: Path) -> None:
    """Neither in the kernels, which are compiled again, nor in the C library."""
    said = elsewhere(NUMBA_CACHE_DIR=str(tmp_path), GLIBC_TUNABLES=HIDDEN, **GENERIC)
    assert said["cpu"] == "generic"
    assert "+avx" not in str(said["features"])
    assert "+fma" not in str(said["features"])
    assert said["digests"] == here


@pytest.mark.skipif(platform.machine() != "x86_64", reason="hides extensions of x86-64")
def test_another_variant_of_the_c_library(here: dict[str, str]) -> None:
    """The same compiled kernels with the C library's simplest function variants."""
    assert elsewhere(GLIBC_TUNABLES=HIDDEN)["digests"] == here
