"""The settings: their defaults, ranges and what makes a map's identity."""

import math
import re

import pytest

from roughmap_schemas import Config, ConfigFault, SensorConfig, config_from, configuration_digest
from roughmap_schemas.config import REMOVED
from roughmap_schemas.keys import TEMPLATES
from roughmap_schemas.layers import DEFAULT_SURFACE

INF = math.inf

LIMITS = {
    "all": {"slope": 0.5, "step": 0.2, "std_dev": 0.1, "confidence": 0.9},
    "ground": {"slope": 0.5, "step": 0.2, "roughness": 0.1, "confidence": 0.9, "clearance": 2.0},
}

DEFAULTS = {
    "map": {
        "name": "site",
        "frame_id": "map",
        "surface": DEFAULT_SURFACE,
        "cell_size": 0.1,
        "error_model": "cuboid",
        "coverage": 2.0,
        "min_radius": 1e-3,
        "min_distance": 1e-3,
        "min_share": 0.05,
        "max_horizontal_radius": 0.5,
        "max_vertical_sigma": 0.5,
        "height_tolerance": 0.05,
        "bounds": None,
        "clear_interval": 0.2,
        "keep": {"radius": INF, "age": INF},
        "levels": 8,
        "memory_limit": 2 * 1024**3,
        "max_new_tiles": 4096,
        "max_tiles": 4_000_000,
        "limits": LIMITS[DEFAULT_SURFACE],
    },
    "zenoh": {
        "mode": "peer",
        "listen": ["tcp/127.0.0.1:7447"],
        "connect": [],
        "scouting": False,
        "shared_memory": False,
        "config_file": None,
        "authority": None,
        "certificate": None,
        "private_key": None,
        "user": None,
        "password": None,
        "password_file": None,
    },
    "input": {
        "max_wait": 0.5,
        "max_pose_gap": 0.5,
        "pose_history": 10.0,
        "max_speed": 30.0,
        "max_leap": 0.3,
        "max_acceleration": 20.0,
        "pose_sigma": (0.05, 0.05, 0.05, 0.01, 0.01, 0.01),
        "placed_sigma": 0.02,
        "max_points": 4_000_000,
        "max_message": 64 * 1024**2,
        "queue_limit": 64 * 1024**2,
        "duplicates": 10_000,
        "robots": [],
    },
    "sensors": {},
    "robots": {},
    "updates": {"layers": ["mean_height", "range", "confidence_factor"], "levels": [0], "update_hz": 2.0},
    "query": {"workers": 4, "max_reply_tiles": 1024, "max_region_cells": 4_000_000},
    "log": {
        "directory": "log",
        "compression": "none",
        "flush_interval": 0.2,
        "checkpoint_interval": 1.0,
        "keep": None,
        "updates": "records",
        "queries": True,
    },
    "store": {"path": None},
    "http": {"listen": "127.0.0.1:8080"},
    "service": {"shutdown_timeout": 8.0, "alive_wait": 15.0},
    "ros2": {"keys": "rmw_zenoh", "domain": 0, "node": "roughmap", "robots": {}, "out": {}},
    "keys": dict(TEMPLATES),
}
"""The contract's table, by hand."""

FREE = {
    "map": {"spill_path", "spill_limit"},
    "input": {"max_robots"},
    "query": {"max_running_cells", "queue_limit", "cache_limit"},
    "log": {"max_file_bytes", "max_file_age", "queue_limit"},
    "store": {"snapshot_interval"},
    "http": {"token", "token_file"},
    "service": {"threads", "log_format", "log_level"},
}
"""Settings whose defaults, or which themselves, the contract leaves open."""

SENSOR_DEFAULTS = {
    "translation": (0, 0, 0),
    "rotation": (0, 0, 0, 1),
    "extrinsics": "configured",
    "range_sigma": 0.02,
    "range_sigma_per_m": 0,
    "range_sigma_per_m2": 0,
    "beam_sigma": 0,
    "mount_sigma": (0,) * 6,
    "min_range": 0,
    "max_range": INF,
    "ceiling": INF,
    "ceiling_slope": 0,
    "time_field": "auto",
    "time_unit": "auto",
    "time_origin": "auto",
    "time_offset": 0,
    "exclude": [],
    "fov": None,
}


def test_the_defaults_are_those_of_the_contract() -> None:
    found = Config().model_dump()
    assert list(found) == list(DEFAULTS)
    for section, table in DEFAULTS.items():
        assert {key: value for key, value in found[section].items() if key not in FREE.get(section, ())} == table
        assert found[section].keys() - table.keys() == FREE.get(section, set())
    assert SensorConfig(range_sigma=0.02).model_dump() == SENSOR_DEFAULTS


def fault(values: dict) -> str:
    with pytest.raises(ConfigFault) as caught:
        config_from(values, "here.toml")
    said = str(caught.value)
    assert said.startswith("here.toml: ")
    assert "\n" not in said
    return said


def lidar(**settings: object) -> dict:
    return {"sensors": {"lidar": {"range_sigma": 0.02, **settings}}}


NAN = math.nan
BAD = [
    # (section, key, value, what is said of it)
    *(("map", "cell_size", value, "greater than") for value in (0, -0.1)),
    *(("map", "cell_size", value, "") for value in (NAN, INF, "wide", True, [0.1], None, 1e-40)),
    ("map", "name", "a b", "1 to 64 of the letters A-Z and a-z"),
    ("map", "name", "", "1 to 64 of the letters"),
    ("map", "name", 5, "string"),
    ("map", "frame_id", "", "at least 1"),
    ("map", "error_model", "sphere", "'point', 'cuboid' or 'ellipsoid'"),
    ("map", "coverage", 0, "greater than"),
    ("map", "min_share", 1.5, "less than or equal to 1"),
    ("map", "min_share", -0.1, "greater than or equal to 0"),
    ("map", "min_share", NAN, ""),
    *(("map", "bounds", value, "") for value in ([0, 0, 1], [0, 0, INF, 1], "0,0,1,1", [0, 0, 1, NAN])),
    *(("map", "bounds", value, "each minimum below its maximum") for value in ([1, 0, 0, 1], [0, 1, 1, 1])),
    *(("map", "levels", value, "") for value in (0, 25, 1.5, True)),
    *(("map", "memory_limit", value, "") for value in (0, -1, "2 GiBs", "lots", "", 1.5, True, "-1MiB")),
    ("map", "max_tiles", 0, "greater than or equal to 1"),
    ("map", "max_horizontal_radius", 30, "at most 256 map.cell_size"),
    ("map", "limits", {"steep": 1}, "slope, step, "),
    ("map", "surface", "both", "'ground' or 'all'"),
    ("map", "keep", {"radius": 0}, "greater than 0"),
    ("map", "clear_interval", -1, "greater than or equal to 0"),
    ("map", "limits", {"slope": 0}, "greater than 0"),
    ("zenoh", "mode", "mesh", "'peer', 'client' or 'router'"),
    ("zenoh", "listen", "tcp/127.0.0.1:7447", "list"),
    *(("zenoh", "listen", [value], "must match") for value in ("", "7447", "tcp/", "/127.0.0.1:7447")),
    ("input", "max_wait", -1, "greater than or equal to 0"),
    ("input", "pose_sigma", [0.1] * 5, ""),
    ("input", "pose_sigma", [0.1] * 5 + [-0.1], "greater than or equal to 0"),
    ("input", "max_message", "64XB", "64MiB"),
    ("input", "robots", ["a/b"], "1 to 64 of the letters"),
    ("input", "robots", ["r1", "r1"], "each value once"),
    ("updates", "layers", ["height"], "mean_height"),
    ("updates", "layers", [], "at least 1"),
    ("updates", "levels", [8], "below map.levels, 0 to 7"),
    ("updates", "levels", [-1], "greater than or equal to 0"),
    ("updates", "update_hz", 0, "greater than 0"),
    ("query", "workers", 0, "greater than or equal to 1"),
    ("query", "max_reply_tiles", "many", "integer"),
    ("log", "directory", "", "at least 1"),
    ("log", "compression", "gzip", "'none', 'lz4' or 'zstd'"),
    ("log", "updates", "all", "'records', 'grids' or 'none'"),
    ("log", "queries", "perhaps", "boolean"),
    *(("http", "listen", value, "host:port") for value in ("8080", ":80", "localhost", "localhost:http", "h:65536")),
    ("service", "shutdown_timeout", 0, "greater than 0"),
    ("keys", "tiles", "tiles/{z}/{x}", "{x}, {y}, {z} once"),
    ("keys", "status", "maps/{map}/events", "must differ from keys.events"),
]


@pytest.mark.parametrize(("section", "key", "value", "words"), BAD, ids=lambda value: str(value)[:20])
def test_values_out_of_range(section: str, key: str, value: object, words: str) -> None:
    said = fault({section: {key: value}})
    assert f" {section}.{key}" in said
    assert words in said


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"range_sigma": -0.1}, "range_sigma"),
        ({"range_sigma": NAN}, "range_sigma"),
        ({"rotation": [0, 0, 0, 0]}, "rotation"),
        ({"rotation": [0, 0, 1]}, "rotation"),
        ({"translation": [0, 0, INF]}, "translation"),
        ({"mount_sigma": [0, 0, 0, 0, 0, -1]}, "mount_sigma"),
        ({"min_range": 2, "max_range": 1}, "min_range"),
        ({"max_range": NAN}, "max_range"),
        ({"max_range": 0}, "max_range"),
        ({"ceiling": NAN}, "ceiling"),
        ({"exclude": [[0, 0, 0, 1, 1, 0]]}, "exclude"),
        ({"exclude": [[0, 0, 0, 1, 1]]}, "exclude"),
    ],
)
def test_sensors_that_cannot_be(settings: dict, key: str) -> None:
    said = fault(lidar(**settings))
    assert "sensors.lidar" in said
    assert key in said


def test_a_sensor_must_say_how_far_it_is_to_be_believed() -> None:
    assert fault({"sensors": {"lidar": {}}}) == "here.toml: sensors.lidar.range_sigma: is required"


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"mapp": {}}, "here.toml: mapp: unknown key, did you mean map? (allowed: map, zenoh, "),
        (
            {"map": {"cell_sise": 1}},
            "here.toml: map.cell_sise: unknown key, did you mean cell_size? (allowed: name, frame_id, surface, ",
        ),
        (
            lidar(range=1),
            "here.toml: sensors.lidar.range: unknown key, did you mean min_range? (allowed: translation, ",
        ),
        (
            {"robots": {"r1": {"sensor": {}}}},
            "here.toml: robots.r1.sensor: unknown key, did you mean sensors? (allowed: pose_covariance, ",
        ),
        ({"keys": {"tile": "a"}}, "here.toml: keys.tile: unknown (allowed: points, "),
        (
            {"sensors": {"lidar": {"range_sgima": 1}}},
            "here.toml: sensors.lidar.range_sgima: unknown key, did you mean range_sigma? (allowed: ",
        ),
        (lidar(rotation=[0, 0]), "here.toml: sensors.lidar.rotation: expected 4 values, found 2"),
        ({"map": 5}, "here.toml: map: must be a table; found 5"),
        (
            {"map": {"limits": "{slope=1}"}},
            "here.toml: map.limits: must be a table (its values one by one, as map.limits.NAME=VALUE); found",
        ),
        ({"map": {"cell_size": 0}}, "here.toml: map.cell_size: must be greater than or equal to 1e-30; found 0"),
    ],
)
def test_unknown_keys(values: dict, words: str) -> None:
    assert fault(values).startswith(words)


@pytest.mark.parametrize("stored", [[1], "map", None, {"map": 1}])
def test_a_stored_configuration_that_is_none_is_a_value_error(stored: object) -> None:
    with pytest.raises(ValueError, match="Config"):
        Config.from_log(stored)


@pytest.mark.parametrize("dotted", REMOVED)
def test_a_removed_setting_is_refused_by_name_but_ignored_in_a_log(dotted: str) -> None:
    section, _, name = dotted.partition(".")
    values = {section: {name: 5}, "map": {"cell_size": 0.2}}
    said = f"here.toml: {dotted}: is no longer a setting (always {REMOVED[dotted]}): remove it"
    assert fault(values) == said
    assert Config.from_log(values).map.cell_size == 0.2
    with pytest.raises(ValueError, match=r"map\.other"):
        Config.from_log({**values, "map": {"other": 1}})


def test_sizes() -> None:
    sizes = {"64MiB": 64 << 20, "1.5GiB": 3 << 29, "100MB": 10**8, "5 kB": 5000, "7": 7, "12B": 12, "1tib": 1 << 40}
    for text, size in sizes.items():
        assert config_from({"map": {"memory_limit": text}}, "here").map.memory_limit == size


def test_nothing_is_written_as_an_empty_text() -> None:
    config = config_from(
        {"map": {"bounds": ""}, "zenoh": {"listen": "", "connect": ""}, "store": {"path": ""}, "http": {"listen": ""}},
        "here",
    )
    assert (config.map.bounds, config.store.path, config.http.listen) == (None, None, None)
    assert (config.zenoh.listen, config.zenoh.connect) == ([], [])


def test_keeping_a_part_of_the_log_needs_a_store() -> None:
    assert fault({"log": {"keep": "1GiB"}}).startswith("here.toml: log.keep: ")
    assert config_from({"log": {"keep": "1GiB"}, "store": {"path": "map.db"}}, "here").log.keep == 1 << 30


def test_the_maps_own_frame_is_no_sensor() -> None:
    assert "sensors.map" in fault({"sensors": {"map": {"range_sigma": 0.1}}})
    assert "robots.r1.sensors.map" in fault({"robots": {"r1": {"sensors": {"map": {"range_sigma": 0.1}}}}})


def test_a_robots_sensor_lies_over_the_general_one() -> None:
    values = lidar(beam_sigma=0.001, translation=[0, 0, 1], rotation=[0, 0, 3, 4])
    values["robots"] = {"r1": {"sensors": {"lidar": {"translation": [1, 0, 0]}, "arm": {"range_sigma": 0.5}}}}
    config = config_from(values, "here")
    general, own = config.sensor("r2", "lidar"), config.sensor("r1", "lidar")
    assert general is not None
    assert own == general.model_copy(update={"translation": (1.0, 0.0, 0.0)})
    assert own.rotation == pytest.approx((0, 0, 0.6, 0.8))  # normalised
    assert config.sensor("r2", "arm") is None
    assert config.sensor("r1", "arm") == SensorConfig(range_sigma=0.5)
    # Without the general one the robot's own must be whole.
    assert "robots.r1.sensors.arm.range_sigma: is required" in fault({"robots": {"r1": {"sensors": {"arm": {}}}}})


IDENTITY = {
    "name": "other",
    "frame_id": "world",
    "surface": "all" if DEFAULT_SURFACE == "ground" else "ground",
    "cell_size": 0.2,
    "error_model": "ellipsoid",
    "coverage": 3.0,
    "min_radius": 2e-3,
    "min_distance": 2e-3,
    "min_share": 0.0,
    "max_horizontal_radius": 0.6,
    "max_vertical_sigma": 0.6,
    "bounds": [0, 0, 1, 1],
}
OTHERS = [
    *(("map", "height_tolerance", 0.1), ("map", "levels", 4), ("map", "memory_limit", "1GiB"), ("map", "limits", {})),
    *(("map", "max_new_tiles", 5), ("map", "max_tiles", 9), ("input", "max_wait", 1), ("log", "compression", "zstd")),
    *(("store", "path", "a.db"), ("keys", "status", "s"), ("sensors", "lidar", {"range_sigma": 1})),
    ("input", "pose_sigma", [1] * 6),
    ("map", "keep", {"radius": 50}),
    ("map", "clear_interval", 1),
]


def test_the_digest_changes_with_the_identity_and_with_nothing_else() -> None:
    base = configuration_digest(Config())
    assert re.fullmatch("[0-9a-f]{32}", base)
    assert set(Config().identity()) == {*IDENTITY, "state_version"}
    digests = {name: configuration_digest(config_from({"map": {name: value}}, "")) for name, value in IDENTITY.items()}
    assert len({base, *digests.values()}) == len(IDENTITY) + 1
    for section, key, value in OTHERS:
        assert configuration_digest(config_from({section: {key: value}}, "")) == base, key
    assert configuration_digest(config_from({"map": {"coverage": 2}}, "")) == base  # 2 is 2.0


@pytest.mark.parametrize("surface", ["ground", "all"])
def test_the_limits_are_those_of_the_surface(surface: str) -> None:
    assert config_from({"map": {"surface": surface}}, "").map.limits == LIMITS[surface]
    own = dict.fromkeys(LIMITS[surface], 0.25)
    assert config_from({"map": {"surface": surface, "limits": own}}, "").map.limits == own
    left = {**LIMITS[surface], "step": 0.3} if surface == "ground" else {"step": 0.3}
    assert config_from({"map": {"surface": surface, "limits": {"step": 0.3}}}, "").map.limits == left
    (other,) = LIMITS.keys() - {surface}
    for name in LIMITS[other].keys() - LIMITS[surface].keys():
        with pytest.raises(ConfigFault, match=f"map.limits: '{name}' is a limit of maps whose surface is '{other}'"):
            config_from({"map": {"surface": surface, "limits": {name: 1.0}}}, "")


def test_clearance_is_bounded() -> None:
    with pytest.raises(ConfigFault, match=r"map\.limits: clearance must be at most 2\.5 m"):
        config_from({"map": {"surface": "ground", "limits": {"clearance": 2.6}}}, "")


def test_settings_of_logs_without_a_surface_are_of_all_points() -> None:
    given = Config().public_dict()
    del given["map"]["surface"], given["map"]["limits"], given["map"]["keep"]
    assert Config.from_log(given).map.surface == "all"


def test_the_time_of_a_robots_pose_errors() -> None:
    given = config_from({"robots": {"r1": {"pose_error_time": 20}}}, "")
    assert (given.pose_error_time("r1"), given.pose_error_time("r2")) == (20.0, 5.0)


@pytest.mark.parametrize(("fov", "kept"), [([10, 20, 90, 180], (10.0, 20.0, 90.0, 180.0)), ("", None)])
def test_a_field_of_view(fov: object, kept: object) -> None:
    assert SensorConfig(range_sigma=0.02, fov=fov).fov == kept
    for wrong in ([10, 20, 90], [91, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 181], "all"):
        with pytest.raises(ValueError, match="fov"):
            SensorConfig(range_sigma=0.02, fov=wrong)


def test_the_public_settings_hide_secrets_and_read_back() -> None:
    values = {
        **lidar(exclude=[[0, 0, 0, 1, 1, 1]], rotation=[0, 0, 3, 4], ceiling=2),
        "zenoh": {"listen": ["tls/0.0.0.0:7447#secret=1"], "connect": ["tcp/h:1?user=a;password=secret", "udp/h:2"]},
        "map": {"bounds": [0, 0, 10, 10], "memory_limit": "1GiB"},
        "robots": {"r1": {"sensors": {"lidar": {"beam_sigma": 1}}}},
    }
    config = config_from(values, "here")
    public = config.public_dict()
    assert "secret" not in str(public)
    assert public["zenoh"]["connect"] == ["tcp/h:1#hidden", "udp/h:2"]
    again = config_from(public, "there")
    assert again.model_copy(update={"zenoh": config.zenoh}) == config
    assert again.public_dict() == public
    assert configuration_digest(again) == configuration_digest(config)
    assert public["sensors"]["lidar"]["max_range"] == "inf"


@pytest.mark.parametrize(("message", "queue"), [(2000, 1000), (1 << 30, 1 << 40)])
def test_a_message_that_could_never_be_taken(message: int, queue: int) -> None:
    with pytest.raises(ValueError, match=r"input\.max_message: must be at most input\.queue_limit"):
        Config.model_validate({"input": {"max_message": message, "queue_limit": queue}})
