"""The coordinate reference system is kept beside the map; stores from before have none."""

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from roughmap import RoughMap
from roughmap_service.store.map_db import Cut, DamagedStore, Store

WKT = 'PROJCS["Grüße / UTM zone 13N",AUTHORITY["EPSG","32613"]]'


@pytest.fixture
def small() -> RoughMap:
    rough_map = RoughMap(cell_size=0.1)
    rough_map.add(np.array([[1.0, 2.0, 3.0]]), np.eye(3) * 1e-4, 5)
    return rough_map


def change(path: Path, statement: str) -> None:
    with closing(sqlite3.connect(path)) as db:
        db.execute(statement)
        db.commit()


def test_it_comes_back_and_a_run_that_goes_on_keeps_it(tmp_path: Path, small: RoughMap) -> None:
    store = Store(tmp_path / "map.db")
    assert store.crs() is None
    store.write_map(small, {}, "digest", "a" * 32, WKT)
    assert store.crs() == WKT
    small.add(np.array([[9.0, 2.0, 3.0]]), np.eye(3) * 1e-4, 6)
    with small.freeze() as frozen:
        store.write(Cut("a" * 32, 0, small.sequence, 1, 1, 2, {}, "digest", digest=small.digest()), frozen, None)
    assert store.crs() == WKT
    assert store.read_cut() is not None


def test_a_map_without_one_has_none(tmp_path: Path, small: RoughMap) -> None:
    store = Store(tmp_path / "map.db")
    store.write_map(small, {}, "digest", "a" * 32)
    assert store.crs() is None
    change(store.path, "DROP TABLE about")
    assert store.crs() is None, "as a store from before"


@pytest.mark.parametrize("statement", ["UPDATE about SET value = 'EPSG:1'", "UPDATE about SET value = x'00'"])
def test_a_damaged_one_is_told(tmp_path: Path, small: RoughMap, statement: str) -> None:
    store = Store(tmp_path / "map.db")
    store.write_map(small, {}, "digest", "a" * 32, WKT)
    change(store.path, statement)
    with pytest.raises(DamagedStore, match="coordinate reference system"):
        store.crs()
