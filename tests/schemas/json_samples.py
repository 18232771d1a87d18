"""One full instance of each JSON model."""

from typing import Any

from pydantic import BaseModel

from roughmap_schemas import (
    CellAnswer,
    CellEntry,
    CellState,
    CheckpointEvent,
    Config,
    ControlAnswer,
    ForgetEvent,
    IntegrationEvent,
    MapStatus,
    QueryError,
    QueryRecord,
    Receipt,
    ResetEvent,
    RunMetadata,
    SensorTimeEvent,
    TileInfo,
    UpdateRecord,
)

HEX = "0123456789abcdef" * 2
DIGEST = "f" * 32

INTEGRATION = IntegrationEvent(
    epoch=2,
    input=9,
    robot="r1",
    poses=[(7, 0), (8, 3)],
    outcome="integrated",
    accepted=5,
    rejected={"range": 2, "time": 1},
    sequence=4,
    cleared=8,
)
CHECKPOINT = CheckpointEvent(epoch=2, sequence=4, digest=DIGEST)
RESET = ResetEvent(epoch=3, sequence=5)
FORGET = ForgetEvent(epoch=3, sequence=6, tiles=[(-3, 0), (-3, 1), (2, -7)])
SENSOR_TIME = SensorTimeEvent(
    epoch=3, robot="r1", frame_id="os.lidar", field="time", unit="us", origin="end", sequence=5
)

TILE: dict[str, Any] = {
    "contract": "1.0",
    "map": "site",
    "instance": HEX,
    "epoch": 2,
    "z": 1,
    "x": -3,
    "y": 4,
    "sequence": 6,
    "map_sequence": 9,
    "answer_tiles": 12,
    "oldest_ns": 1,
    "newest_ns": 2,
    "known_cells": 77,
    "digest": DIGEST,
    "configuration_digest": HEX,
    "compression": "zstd",
    "surface": "ground",
}

STATUS: dict[str, Any] = {
    "contract": "1.0",
    "map": "site",
    "run": HEX,
    "instance": HEX,
    "epoch": 1,
    "version": "0.1.0",
    "frame_id": "map",
    "cell_size": 0.1,
    "tile_cells": 64,
    "levels": 8,
    "layers": ["mean_height"],
    "bounds": None,
    "extent": [-6.4, 0.0, 6.4, 12.8],
    "error_model": "cuboid",
    "surface": "ground",
    "configuration_digest": HEX,
    "health": "ok",
    "sequence": 7,
    "durable_sequence": 6,
    "input": 30,
    "newest_stamp_ns": 1_600_000_000_123_456_789,
    "clouds": {"accepted": 7, "waiting": 1, "rejected": {"pose_gap": 1}},
    "points": {"accepted": 700, "rejected": {"not_finite": 3, "bounds": 1}},
    "poses": {"accepted": 20, "rejected": {"duplicate": 1, "bad_covariance": 1}},
    "refused": {"bad_message": 2, "unknown_sensor": 1},
    "gaps": {"r1": 4},
    "jumps": {"r1": 1},
    "problems": {"robot r1": "robot r1: no pose was taken"},
    "recent": ["robot r1: its pose leapt 2.50 m, 0.00 rad in 0.100 s (3 s ago)"],
    "lag_s": {"p50": 0.01, "p99": None},
    "rates": {"clouds": 10.0, "points": 1e6, "poses": 50.0},
    "memory_bytes": 1 << 28,
    "tiles": {"resident": 5, "spilled": 0},
    "forgotten": 3,
    "log": {
        "file": "a.mcap",
        "bytes": 123,
        "ok": True,
        "bytes_per_hour": 10**9,
        "hours_to_full_disk": 2.5,
        "keep": None,
    },
    "uptime_s": 12.5,
}

STATE: dict[str, Any] = {
    "count": 3,
    "updated": 1_600_000_000,
    "weight": 3.5,
    "weight_sq": 4.5,
    "mean": -0.25,
    "m2": 0.0,
    "min": -0.5,
    "max": 0.1,
    "inv_cf": 1e6,
    "variance": 0.25,
    "shared": 0.125,
    "pose_variance": 0.5,
    "mount_sigma": 0.0,
    "off_ground": [{"height": 1.125, "hits": 15}],
}

METADATA: dict[str, Any] = {
    "run": HEX,
    "created_ns": 5,
    "epoch": 1,
    "index": 0,
    "first_input": 1,
    "first_record": 1,
    "base_sequence": 0,
    "base_digest": DIGEST,
    "version": "0.1.0",
    "rules": 2,
    "state_version": 2,
    "configuration": Config().public_dict(),
}

SAMPLES: dict[str, BaseModel] = {
    "CellAnswer": CellAnswer(
        map="site",
        instance=HEX,
        epoch=1,
        sequence=2,
        cells=[
            CellEntry(
                x=0.5, y=-0.5, i=5, j=-5, state=CellState(**STATE), layers={"std_dev": float("nan"), "count": 3.0}
            ),
            CellEntry(x=9.0, y=9.0, i=90, j=90, state=None, layers={}),
        ],
    ),
    "ControlAnswer": ControlAnswer(sequence=4, epoch=2, tiles=6),
    "MapStatus": MapStatus.model_validate(STATUS),
    "QueryError": QueryError(code="bad_bbox", message="bbox: expected ..."),
    "QueryRecord": QueryRecord(selector="maps/site/tiles/0/*/*", tiles=3, sequence=4, duration_ns=10**6, outcome="ok"),
    "Receipt": Receipt(input=5, epoch=1, duplicate=True),
    "RunMetadata": RunMetadata.model_validate(METADATA),
    "TileInfo": TileInfo(**TILE),
    "UpdateRecord": UpdateRecord(key="maps/site/updates/1/-3/4", info=TileInfo(**TILE)),
}
EVENTS = (INTEGRATION, CHECKPOINT, RESET, FORGET, SENSOR_TIME)
