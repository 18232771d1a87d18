"""What tests of tiles outside memory begin with."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from roughmap_service.store.spill import SLICE_BYTES, Spill


@pytest.fixture
def spill(tmp_path: Path) -> Iterator[Spill]:
    with Spill(tmp_path / "tiles.spill", 1000 * SLICE_BYTES) as opened:
        yield opened
