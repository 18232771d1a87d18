"""Fixtures of the exports' tests."""

from pathlib import Path

import pytest
from exported_map import Stored, store


@pytest.fixture(scope="session")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Stored:
    return store(tmp_path_factory.mktemp("exported"))


@pytest.fixture
def export(stored: Stored, tmp_path: Path):
    """A function that exports the stored map by the command line, and returns the file."""
    from click.testing import CliRunner

    from roughmap_service.cli.export import export as command

    def run(name: str, *options: str) -> Path:
        file = tmp_path / name
        done = CliRunner().invoke(command, [str(stored.path), "-o", str(file), *options], catch_exceptions=False)
        assert done.exit_code == 0, done.output
        return file

    return run
