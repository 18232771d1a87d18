"""The folder of recordings, from `make test-recordings DATA=FOLDER`; the judges of `make map-right` within reach."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[1] / "map_right"))


@pytest.fixture(scope="session")
def recordings(request: pytest.FixtureRequest) -> Path:
    folder: Path | None = request.config.getoption("--recordings")
    if folder is None or not folder.is_dir():
        pytest.fail(f"no folder of recordings: {folder}; give one with --recordings")
    return folder.resolve()
