"""What tests of tiles outside memory begin with."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from roughmap.memory import SLOT_BYTES
from roughmap_service.spill import Spill


@pytest.fixture
def spill(tmp_path: Path) -> Iterator[Spill]:
    with Spill(tmp_path / "tiles.spill", 1000 * SLOT_BYTES) as opened:
        yield opened
