"""The page on readers: its example is a reader that passes the kit's checks."""

import re
import types
from pathlib import Path

import numpy as np
import pytest

from roughmap_service import formats
from roughmap_service.formats.clouds import FOLDERS, READERS
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import CloudFileFault

README = (Path(formats.__file__).parent / "README.md").read_text()


def test_the_example_is_a_reader(tmp_path: Path) -> None:
    (source,) = (block for block in re.findall(r"```python\n(.*?)```", README, re.DOTALL) if "POINT =" in block)
    module = types.ModuleType("f64")
    exec(compile(source, "README.md", "exec"), module.__dict__)
    points = np.random.default_rng(1).uniform(4e6, 5e6, (50, 3))
    (tmp_path / "cloud.f64").write_bytes(points.astype("<f8").tobytes())
    (part,) = module.read_f64(tmp_path / "cloud.f64", ReadOptions())
    assert np.array_equal(part.points, points)
    (tmp_path / "cloud.f64").write_bytes(bytes(25))
    with pytest.raises(CloudFileFault, match="found 1 bytes more"):
        list(module.read_f64(tmp_path / "cloud.f64", ReadOptions()))


def test_every_format_has_its_row() -> None:
    table = README.partition("\n## ")[0]
    missing = [suffix for suffix in READERS if f"`{suffix}`" not in table and suffix not in {".bag", ".db3", ".mcap"}]
    assert missing == []
    assert all(name.rstrip("/") in table or name == "metadata.yaml" for name in FOLDERS)
