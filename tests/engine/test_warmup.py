"""What the first scan and the first query would wait for is compiled before the service is ready."""

import importlib
import logging
import pkgutil
import threading
from itertools import product

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

import roughmap
from roughmap.reading.cell_values import known_bits
from roughmap_schemas import Config, contract_timed, decode_cloud, encode_cloud
from roughmap_schemas.layers import layers_of
from roughmap_service.engine import warmup
from roughmap_service.engine.warmup import UNTURNED, warm_up
from roughmap_service.run.placing import place_cloud
from roughmap_service.run.poses import Pose
from roughmap_service.run.settings import Settings, new_map

MODULES = [
    importlib.import_module(found.name)
    for found in pkgutil.walk_packages(roughmap.__path__, "roughmap.")
    if not found.name.startswith("roughmap.reference")
]


def compiled() -> dict[str, int]:
    """Of each kernel, for how many kinds of arguments there is machine code."""
    found = {}
    for module in MODULES:
        for name, value in vars(module).items():
            if isinstance(value, Dispatcher):
                found[f"{module.__name__}.{name}"] = len(value.signatures)
    return found


@pytest.mark.parametrize("surface", ["ground", "all"])
@pytest.mark.parametrize("model", ["point", "cuboid", "ellipsoid"])
def test_no_cloud_and_no_query_finds_a_kernel_uncompiled(model: str, surface: str) -> None:
    config = Config.model_validate(
        {"map": {"error_model": model, "surface": surface}, "sensors": {"lidar": {"range_sigma": 0.02}}}
    )
    warm_up(config, threading.Event())
    before = compiled()
    assert before["roughmap.integration.blocks.scan_blocks"] > 0
    assert before["roughmap.integration.blocks.point_blocks"] > 0
    if surface == "ground":
        assert before["roughmap.integration.clearing.clear_tiles"] > 0
    settings = Settings(config)
    line = [Pose(k * 10**9, (0.0, 0.0, 0.0), UNTURNED, None, 1, 0) for k in (0, 1)]
    points = np.random.default_rng(0).uniform(-5.0, 5.0, (5000, 3))
    offsets = np.arange(5000) * 1000
    layouts = set()
    with new_map(config) as rough_map:
        # Longer stamps make longer messages: the points begin at other addresses, aligned for their type or not.
        for dtype, frame, times, stamp in product(
            (np.float32, np.float64), ("map", "lidar"), (None, offsets), (0, 1, 1 << 7, 1 << 14)
        ):
            payload = encode_cloud(points.astype(dtype), stamp, frame, offsets_ns=times)
            cloud = contract_timed(decode_cloud(payload, max_message=1 << 20, max_points=1 << 20))
            layouts.add((dtype, cloud.points.flags.aligned, cloud.points.flags.c_contiguous))
            with rough_map.freeze():
                rough_map.integrate(place_cloud(rough_map, "", cloud, line, settings, clear=settings.clears))
        for level in (0, 1):
            with rough_map.freeze(level) as frozen:
                known_bits(frozen.records(0, 0))
                for name in layers_of(surface):
                    frozen.packed_layers(0, 0, [name])
                    frozen.tile_layers(0, 0, [name])
        rough_map._table.pool.take_columns(rough_map._table.slot[:1])
        for _ in range(2):  # tiles with columns are copied, too
            with rough_map.freeze():
                rough_map._table.make_writable(np.zeros(1, np.int32))
        rough_map.forget([(0, 0)])
    assert {aligned for _, aligned, _ in layouts} == {True, False}, "both kinds came by"
    assert {packed for _, _, packed in layouts} == {True, False}, "and with other fields between"
    assert compiled() == before


def test_a_start_that_takes_long_says_why(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    told = threading.Event()
    monkeypatch.setattr(warmup, "TELL_SECONDS", 0.0)
    monkeypatch.setattr(warmup, "note", lambda *args: (logging.getLogger().warning("%s: %s", *args[2:]), told.set()))
    monkeypatch.setattr(warmup, "_run", lambda _config, _stop: told.wait(30))
    warm_up(Config(), threading.Event())
    assert caplog.messages == ["compiling: compiling kernels, once; this takes a minute or more"]
    assert not [thread for thread in threading.enumerate() if isinstance(thread, threading.Timer) and thread.is_alive()]
