"""`make faults`, shortened: trials that kill a service under load or cut its power, a few times, of one seed."""

from pathlib import Path

import paths  # noqa: F401 - before what it makes importable
import pytest
from short_trials import KILLED, nothing_is_found


@pytest.mark.parametrize("name", KILLED)
def test_nothing_is_found(name: str, tmp_path: Path) -> None:
    nothing_is_found(name, tmp_path)
