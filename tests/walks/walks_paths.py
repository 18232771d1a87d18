"""So that these modules find the tests' own, whether pytest or a command of `make` loads them."""

import sys
from pathlib import Path

TESTS = Path(__file__).parents[1]
for folder in (TESTS, TESTS / "walks", TESTS / "ros_bridge"):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
