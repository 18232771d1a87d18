"""make own-bag

A new user's first ten minutes: a wheel of this tree is installed into a new environment, and the commands of the
README's section "A map from your own bag" are run there, one after another, on a bag of a simulated robot. Prints how
long each took; exits 1 if one fails or all together take more than ten minutes.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import walks_paths  # noqa: F401 - before what it makes importable
from ros_rover import CLOUDS, ODOMETRY, TF_STATIC, TYPES, cloud, messages, odometry, transform
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

ROOT = Path(__file__).parents[2]
TITLE = "## A map from your own bag"
LIMIT_S = 600.0

EXPECTED = {"map.db": 50_000, "height.png": 1_000, "ground.tif": 10_000, "costmap.pgm": 1_000, "costmap.yaml": 100}
"""The files that must be there in the end, with their least sizes in bytes."""


def commands(readme: str) -> list[str]:
    """Return the commands of the section's first block."""
    section = readme[readme.index(TITLE) :]
    found = re.search(r"```sh\n(.*?)```", section, re.DOTALL)
    assert found is not None, f"{TITLE} has no commands"
    return [line.split("   #")[0].strip() for line in found[1].splitlines() if line.strip()]


def record(folder: Path, seconds: float) -> Path:
    """Write the bag of a drive, as `ros2 bag record -a` would: clouds, odometry and static transforms."""
    ros = get_typestore(Stores.ROS2_KILTED)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        topics = {
            topic: bag.add_connection(topic, TYPES[topic], typestore=ros) for topic in (CLOUDS, ODOMETRY, TF_STATIC)
        }
        drive = messages(seconds)
        mount = transform(0, "base", "lidar", (0.25, 0.0, 1.05))
        bag.write(topics[TF_STATIC], drive[0].due_ns, mount)
        for message in drive:
            if message.kind == "points":
                bag.write(topics[CLOUDS], message.due_ns, cloud(message.payload))
            else:
                bag.write(topics[ODOMETRY], message.due_ns, odometry(message.payload))
    return folder


def main() -> int:
    """Build, install, walk, tell."""
    parser = argparse.ArgumentParser(prog="make own-bag", description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the bag (default: 20)")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="leave everything there, to look at it")
    asked = parser.parse_args()
    room = asked.keep or Path(tempfile.mkdtemp(prefix="roughmap-own-bag-"))
    room.mkdir(parents=True, exist_ok=True)
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", room, ROOT],
        check=True, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    (wheel,) = room.glob("*.whl")
    record(room / "my_bag", asked.seconds)
    environment = {
        name: value for name, value in os.environ.items()
        if not name.startswith("ROUGHMAP_") and name not in {"PYTHONPATH", "VIRTUAL_ENV"}
    }  # fmt: skip
    begun, activated = time.monotonic(), ""
    for command in commands((ROOT / "README.md").read_text()):
        line = command.replace("'roughmap[geo]'", f"'{wheel}[geo]'")
        at = time.monotonic()
        done = subprocess.run(
            ["bash", "-ec", f"{activated}{line}"], cwd=room, env=environment, timeout=LIMIT_S, check=False
        )
        print(f"{time.monotonic() - at:7.1f} s  {command}", flush=True)
        if done.returncode:
            print(f"FOUND exit code {done.returncode}: {command}")
            return 1
        if "activate" in command:
            activated = f"{command.split('&&')[-1].strip()}; "
    taken = time.monotonic() - begun
    print(f"{taken:7.1f} s  in all")
    found = [f"{name} is missing or too small" for name, least in EXPECTED.items() if _size(room / name) < least]
    found += [f"it took {taken:.0f} s, not at most {LIMIT_S:.0f}"] if taken > LIMIT_S else []
    for line in found:
        print(f"FOUND {line}")
    if asked.keep is None and not found:
        shutil.rmtree(room)
    return 1 if found else 0


def _size(file: Path) -> int:
    return file.stat().st_size if file.is_file() else 0


if __name__ == "__main__":
    sys.exit(main())
