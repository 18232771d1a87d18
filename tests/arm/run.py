"""Compare the digests of maps made on 64-bit ARM, by emulation, with those of this machine.

    make arm-test                              the first run, which compiles all kernels, takes 5 to 10 minutes
    make arm-test ARGS="--cpu cortex-a72"      kernels for this CPU; may be given several times

`tests/arm/setup` makes the ARM system once.
"""

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
PROGRAM = REPOSITORY / "tests/core/digest_program.py"
FOLDER = Path(os.environ.get("ROUGHMAP_ARM", "/var/lib/roughmap-arm"))
TIMEOUT = 7200
"""Seconds for one CPU. Compiling takes 5 to 10 minutes on an idle machine."""

NEEDED = ("llvmlite", "numba", "numpy", "xxhash")


def locked() -> str:
    """The lines of requirements.lock that lock what the core needs."""
    lines = (REPOSITORY / "requirements.lock").read_text()
    return "".join(re.search(rf"^{name}==.*?(?=^\S)", lines, re.DOTALL | re.MULTILINE)[0] for name in NEEDED)


def wheels() -> Path:
    """Return a folder with the ARM wheels of the locked versions, which pip unpacks if it is not there yet."""
    wanted = locked()
    folder = FOLDER / "wheels" / hashlib.sha256(wanted.encode()).hexdigest()[:16]
    if folder.exists():
        return folder
    unfinished = folder.with_suffix(f".{os.getpid()}")
    list_of = unfinished.with_suffix(".txt")
    list_of.write_text(wanted)
    platforms = [f"--platform=manylinux{name}_aarch64" for name in ("2014", "_2_17", "_2_27", "_2_28")]
    subprocess.run(
        [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps",
         "--require-hashes", "--only-binary=:all:", "--python-version=3.11", "--implementation=cp", *platforms,
         f"--target={unfinished}", "-r", str(list_of)],
        check=True,
    )  # fmt: skip
    list_of.unlink()
    unfinished.rename(folder)
    return folder


def on_arm(cpu: str) -> dict[str, object]:
    """Run the program under emulation, with kernels for ``cpu``."""
    root = FOLDER / "root"
    environment = {
        "PYTHONPATH": f"{REPOSITORY}:{wheels()}",
        "PYTHONDONTWRITEBYTECODE": "1",
        "NUMBA_CACHE_DIR": str(FOLDER / "kernels"),
        "NUMBA_CPU_NAME": cpu,
        "NUMBA_CPU_FEATURES": "",
        "PATH": os.environ["PATH"],
        "HOME": str(FOLDER),
    }
    return said(
        [str(shutil.which("qemu-aarch64")), "-L", str(root), f"{root}/usr/bin/python3.11", str(PROGRAM)], environment
    )


def said(command: list[str], environment: dict[str, str]) -> dict[str, object]:
    """Run a command and return the JSON that it prints."""
    made = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True, timeout=TIMEOUT)
    found: dict[str, object] = json.loads(made.stdout)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cpu", action="append", metavar="NAME", help="as in LLVM: generic, cortex-a72, neoverse-v1")
    cpus = parser.parse_args().cpu or ["generic"]
    if not (FOLDER / "ready").exists() or shutil.which("qemu-aarch64") is None:
        print("no ARM system here: sudo tests/arm/setup", file=sys.stderr)
        return 2
    here = said([sys.executable, str(PROGRAM)], {**os.environ, "PYTHONPATH": str(REPOSITORY)})["digests"]
    differ = 0
    for cpu in cpus:
        start = time.monotonic()
        there = on_arm(cpu)["digests"]
        for name, digest in here.items():
            if there.get(name) != digest:
                differ += 1
                print(f"{cpu}: {name}: {there.get(name)}, here {digest}")
        print(f"{cpu}: {len(here)} digests compared in {time.monotonic() - start:.0f} s")
    print("all digests are equal" if not differ else f"{differ} digests differ")
    return 1 if differ else 0


if __name__ == "__main__":
    sys.exit(main())
