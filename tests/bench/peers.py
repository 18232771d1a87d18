"""What can be had by pip beside us, at the nearest equal job over the same points, in one run: nanoseconds a point.

    python tests/bench/peers.py [--quick] [--out FOLDER]

Makes an environment of its own in FOLDER/peers, installs there what installs, says what doesn't, and runs
`peers_run.py` in it.
"""

import argparse
import json
import os
import subprocess
import sys
import venv
from importlib.metadata import version
from pathlib import Path

HERE = Path(__file__).parent
OURS = ("numpy", "numba", "scipy", "xxhash")
"""What the map core and the jobs need, in the versions that we use."""

PEERS = ("pandas", "polars", "datashader", "octomap-python", "pyoctomap")
INSTALL_S = 600.0


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few scans, two rounds: is it whole?")
    parser.add_argument("--out", type=Path, default=Path("bench"), help="for the environment, scans and JSON [bench]")
    given = parser.parse_args(arguments)
    folder = (given.out / "peers").resolve()
    python = folder / "bin" / "python"
    if not python.exists():
        venv.create(folder, with_pip=True)
    why = _install(python, [f"{name}=={version(name)}" for name in OURS])
    if why:
        print(f"bench: numpy, numba, scipy and xxhash could not be installed in {folder}: {why}", file=sys.stderr)
        return 1
    missing = {peer: why for peer in PEERS if (why := _install(python, [peer]))}
    done = subprocess.run(
        [python, HERE / "peers_run.py", given.out.resolve(), json.dumps({"quick": given.quick, "missing": missing})],
        env={**os.environ, "PYTHONPATH": str(HERE.parents[1]), "POLARS_MAX_THREADS": "1"}, check=False,
    )  # fmt: skip
    return done.returncode


def _install(python: Path, packages: list[str]) -> str:
    """Install; why that failed, "" if it did not."""
    print(f"bench: installing {', '.join(packages)}", file=sys.stderr)
    try:
        done = subprocess.run(
            [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *packages],
            capture_output=True, text=True, timeout=INSTALL_S, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"not installed within {INSTALL_S:g} s"
    errors = [line for line in done.stderr.splitlines() if "error" in line.lower()] or ["pip failed"]
    return errors[-1][:200] if done.returncode else ""


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
