"""What tests of tiles outside memory begin with."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from roughmap.tiles.slots import SLOT_BYTES
from roughmap_service.store.spill import Spill


@pytest.fixture
def spill(tmp_path: Path) -> Iterator[Spill]:
    with Spill(tmp_path / "tiles.spill", 1000 * SLOT_BYTES) as opened:
        yield opened
