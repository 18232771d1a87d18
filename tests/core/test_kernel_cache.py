"""Compiled kernels are cached on disk, and compiled again when any source they may depend on changes."""

import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numba

import roughmap

PROGRAM = """
import numpy as np
from roughmap.points.trajectory import Trajectory, _half_angles
turned = np.array([[0, 0, 0, 1], [0, 0, 1, 0]])  # half a turn: the quaternions are a quarter turn apart
angles = Trajectory([0, 1], np.zeros((2, 3)), turned, np.zeros((2, 6, 6))).arrays[4]
print(angles[0], sum(_half_angles.stats.cache_hits.values()))
"""


def run(folder: Path, **more: str) -> tuple[float, bool]:
    """Return the angle of half a turn from the package in ``folder``, and whether the kernel came from disk."""
    # The current folder comes first in the search for modules.
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=folder,
        env={**environment, **more},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    said, hits = done.stdout.split()
    return float(said), int(hits) > 0


def test_a_change_in_a_helper_of_another_file_counts(tmp_path: Path) -> None:
    """`_half_angles` is in trajectory.py; the arc tangent that is compiled into it is in poly.py."""
    package = Path(roughmap.__file__).parent
    shutil.copytree(package, tmp_path / "roughmap", ignore=shutil.ignore_patterns("__pycache__"))
    angle, kept = run(tmp_path)
    assert (round(angle, 12), kept) == (1.570796326795, False)
    assert run(tmp_path) == (angle, True)
    helper = tmp_path / "roughmap" / "points" / "poly.py"
    text = helper.read_text()
    changed = text.replace("0.25 * math.pi", "0.75 * math.pi")
    assert changed != text
    helper.write_text(changed)
    angle, kept = run(tmp_path)
    assert (round(angle, 12), kept) == (4.712388980385, False)  # three times as much


def test_kernels_beside_the_source_serve_another_folder(tmp_path: Path) -> None:
    """As in a container image: shipped kernels are read in place, and new ones are saved to the writable folder."""
    package = Path(roughmap.__file__).parent
    shutil.copytree(package, tmp_path / "roughmap", ignore=shutil.ignore_patterns("__pycache__"))
    own = tmp_path / "own"
    angle, _ = run(tmp_path)
    beside = sorted((tmp_path / "roughmap" / "points" / "__pycache__").glob("*.nb?"))
    assert run(tmp_path, NUMBA_CACHE_DIR=str(own)) == (angle, True)
    assert not list(own.rglob("*.nb?"))
    other = {"NUMBA_CACHE_DIR": str(own), "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    assert run(tmp_path, **other) == (angle, False)
    assert list(own.rglob("*.nbc"))
    assert run(tmp_path, **other) == (angle, True)
    assert sorted((tmp_path / "roughmap" / "points" / "__pycache__").glob("*.nb?")) == beside


def test_an_index_that_names_a_type_of_another_version_is_replaced(tmp_path: Path) -> None:
    """Signatures are pickled with the types of their arguments; a type may have gone since."""
    package = Path(roughmap.__file__).parent
    shutil.copytree(package, tmp_path / "roughmap", ignore=shutil.ignore_patterns("__pycache__"))
    angle, _ = run(tmp_path)
    version = pickle.dumps(numba.__version__)
    indexes = list((tmp_path / "roughmap" / "points" / "__pycache__").glob("trajectory._half_angles*.nbi"))
    assert len(indexes) == 1
    indexes[0].write_bytes(version + b"croughmap.cell\nNoSuchType\n.")
    assert run(tmp_path) == (angle, False)
    assert run(tmp_path) == (angle, True)
