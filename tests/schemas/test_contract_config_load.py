"""Reading the settings: file, environment, command line, each over the one before, and faults that name all three."""

from pathlib import Path

import pytest

from roughmap_schemas import ConfigFault, LoadedConfig, load_config
from roughmap_schemas.layers import DEFAULT_LIMITS, default_limits

TOML = """
[map]
name = "quarry"
cell_size = 0.2
surface = "all"
limits = { slope = 0.4 }

[zenoh]
listen = ["tcp/127.0.0.1:0"]

[sensors.lidar]
range_sigma = 0.02
max_range = inf

[sensors."front camera"]
range_sigma = 0.1
max_range = 5.0

[robots.Rover.sensors.lidar]
translation = [0, 0, 0.5]
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "quarry.toml"
    path.write_text(TOML, encoding="utf-8")
    return path


def fault(file: Path | None, overrides: dict | None = None, environ: dict | None = None) -> str:
    with pytest.raises(ConfigFault) as caught:
        load_config(file, overrides, environ)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_each_goes_over_the_one_before(file: Path) -> None:
    environ = {"ROUGHMAP_MAP__NAME": "pit", "ROUGHMAP_MAP__COVERAGE": "3", "PATH": "/bin", "ROUGHMAPS": "1"}
    loaded = load_config(file, {"map.coverage": "2.5", "log.directory": "elsewhere"}, environ)
    config = loaded.config
    assert (config.map.cell_size, config.map.name, config.map.coverage) == (0.2, "pit", 2.5)
    assert (config.log.directory, config.map.min_share) == ("elsewhere", 0.05)
    sources = {key: loaded.sources[key] for key in ("map.cell_size", "map.name", "map.coverage", "map.min_share")}
    assert sources == {
        "map.cell_size": f"file {file}",
        "map.name": "environment ROUGHMAP_MAP__NAME",
        "map.coverage": "command line",
        "map.min_share": "default",
    }
    assert loaded.path == file
    assert [loaded.given(key) for key in ("map.name", "map.min_share")] == [True, False]


def test_without_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    loaded = load_config()
    assert isinstance(loaded, LoadedConfig)
    assert (loaded.path, loaded.config.map.name) == (None, "site")
    assert set(loaded.sources.values()) == {"default"}


def test_the_file_of_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("roughmap.toml").write_text('map.name = "here"', encoding="utf-8")
    other = tmp_path / "other.toml"
    other.write_text("", encoding="utf-8")
    assert load_config().config.map.name == "here"
    assert load_config(other).config.map.name == "site"


def test_robots_and_sensors_of_a_file(file: Path) -> None:
    loaded = load_config(file)
    own = loaded.config.sensor("Rover", "lidar")
    assert own is not None
    assert (own.translation, own.range_sigma) == ((0.0, 0.0, 0.5), 0.02)
    assert loaded.config.sensor("Rover", "front camera") is not None  # names as they stand, blanks and capitals too
    assert loaded.sources["robots.Rover.sensors.lidar.translation"] == f"file {file}"
    assert loaded.sources["robots.Rover.sensors.lidar.range_sigma"] == f"file {file}"
    assert loaded.sources["robots.Rover.sensors.lidar.beam_sigma"] == "default"


BY_TRANSFORM = 'extrinsics = "transform"'
BESIDE = f"can't be set beside {BY_TRANSFORM}"


@pytest.mark.parametrize(
    ("general", "own", "said"),
    [
        (f"translation = [0, 0, 1]\n{BY_TRANSFORM}", None, f"sensors.lidar: translation {BESIDE}; keep one"),
        (f"rotation = [0, 0, 0, 1]\n{BY_TRANSFORM}", "", f"sensors.lidar: rotation {BESIDE}; keep one"),
        (
            "",
            f"{BY_TRANSFORM}\ntranslation = [0, 0, 1]\nrotation = [0, 0, 0, 1]",
            f"robots.r1.sensors.lidar: translation and rotation {BESIDE}; keep one",
        ),
        (
            BY_TRANSFORM,
            "translation = [0, 0, 1]",
            f"robots.r1.sensors.lidar: translation {BESIDE} in the general table of that frame; keep one",
        ),
    ],
)
def test_a_mounting_has_one_source(tmp_path: Path, general: str, own: str | None, said: str) -> None:
    path = tmp_path / "two.toml"
    robots = "" if own is None else f"[robots.r1.sensors.lidar]\n{own}\n"
    path.write_text(f"[sensors.lidar]\nrange_sigma = 0.1\n{general}\n{robots}")
    assert fault(path) == f"{path}: {said}"


@pytest.mark.parametrize(
    ("general", "own", "source", "place"),
    [
        ("translation = [0, 0, 1]", BY_TRANSFORM, "transform", (0.0, 0.0, 1.0)),  # it is not looked at
        (BY_TRANSFORM, 'extrinsics = "configured"\ntranslation = [0, 0, 2]', "configured", (0.0, 0.0, 2.0)),
        (BY_TRANSFORM, "range_sigma = 0.2", "transform", (0.0, 0.0, 0.0)),
    ],
)
def test_a_robot_may_have_another_source_of_a_mounting(
    tmp_path: Path, general: str, own: str, source: str, place: tuple[float, ...]
) -> None:
    path = tmp_path / "own.toml"
    path.write_text(f"[sensors.lidar]\nrange_sigma = 0.1\n{general}\n[robots.r1.sensors.lidar]\n{own}\n")
    sensor = load_config(path).config.sensor("r1", "lidar")
    assert sensor is not None
    assert (sensor.extrinsics, sensor.translation) == (source, place)


def test_the_source_of_a_robots_sensor_whose_name_has_dots(tmp_path: Path) -> None:
    path = tmp_path / "dots.toml"
    path.write_text('sensors."os.top".range_sigma = 0.1\n[robots."a.b".sensors."os.top"]\nbeam_sigma = 0.2')
    sources, prefix = load_config(path).sources, "robots.a.b.sensors.os.top"
    assert (sources[f"{prefix}.range_sigma"], sources[f"{prefix}.beam_sigma"]) == (f"file {path}", f"file {path}")
    assert sources[f"{prefix}.max_range"] == "default"


@pytest.mark.parametrize("section", ["sensors", "robots"])
def test_robots_and_sensors_are_set_in_files_only(section: str) -> None:
    name = f"ROUGHMAP_{section.upper()}__LIDAR__RANGE_SIGMA"
    said = fault(None, environ={name: "0.1"})
    assert said.startswith(f"environment {name}: {section}.lidar.range_sigma: {section} can only be set in a file")
    assert "command line" in fault(None, {f"{section}.lidar.range_sigma": 0.1})


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("ZENOH__LISTEN", '["tcp/127.0.0.1:0", "tcp/127.0.0.1:1"]', ["tcp/127.0.0.1:0", "tcp/127.0.0.1:1"]),
        ("ZENOH__LISTEN", "", []),
        ("ZENOH__SCOUTING", "true", True),
        ("MAP__BOUNDS", "[0, -1, 2.5, 3]", (0.0, -1.0, 2.5, 3.0)),
        ("MAP__BOUNDS", "", None),
        ("MAP__NAME", "123", "123"),
        ("MAP__MEMORY_LIMIT", "1MiB", 1 << 20),
        ("UPDATES__LEVELS", "[0, 2]", [0, 2]),
        ("INPUT__POSE_SIGMA", "[1, 1, 1, 0, 0, 0]", (1.0, 1.0, 1.0, 0.0, 0.0, 0.0)),
        ("KEYS__STATUS", "health/{map}", "health/{map}"),
    ],
)
def test_variables(name: str, text: str, expected: object) -> None:
    section, _, key = name.lower().partition("__")
    config = load_config(None, environ={f"ROUGHMAP_{name}": text}).config
    table = getattr(config, section)
    assert (table[key] if section == "keys" else getattr(table, key)) == expected


def test_one_limit_alone_over_those_below(file: Path) -> None:
    """Over the file's where it has any, else over the defaults."""
    environ = {"ROUGHMAP_MAP__LIMITS__STEP": "0.3"}
    assert load_config(file, environ=environ).config.map.limits == {"slope": 0.4, "step": 0.3}
    loaded = load_config(None, {"map.limits.slope": 0.1}, environ)
    assert loaded.config.map.limits == {**default_limits(None), "slope": 0.1, "step": 0.3}
    assert load_config(file, {"map.limits": {"step": 1}}).config.map.limits == {"step": 1.0}


@pytest.mark.parametrize("surface", ["all", "ground"])
def test_one_limit_alone_over_the_defaults_of_the_surface(surface: str) -> None:
    """Whichever of the two is named first, and where."""
    given = {"map.limits.slope": 0.1, "map.surface": surface}
    expected = {**DEFAULT_LIMITS[surface], "slope": 0.1}
    assert load_config(None, given).config.map.limits == expected
    environ = {"ROUGHMAP_MAP__LIMITS__SLOPE": "0.1", "ROUGHMAP_MAP__SURFACE": surface}
    assert load_config(None, environ=environ).config.map.limits == expected


def test_what_is_kept_can_be_set_one_by_one() -> None:
    loaded = load_config(None, {"map.keep.radius": 50}, {"ROUGHMAP_MAP__KEEP__AGE": "600"})
    assert loaded.config.map.keep.model_dump() == {"radius": 50.0, "age": 600.0}
    assert loaded.sources["map.keep.radius"] == "command line"
    with pytest.raises(ConfigFault, match=r"map\.keep\.radios: unknown key, did you mean radius\?"):
        load_config(None, {"map.keep.radios": 50})


def test_the_source_of_each_limit(file: Path) -> None:
    def sources(loaded: LoadedConfig) -> dict[str, str]:
        return {key: source for key, source in loaded.sources.items() if key.startswith("map.limits")}

    one = {"ROUGHMAP_MAP__LIMITS__STEP": "0.3"}
    assert sources(load_config(file, environ=one)) == {
        "map.limits.slope": f"file {file}",
        "map.limits.step": "environment ROUGHMAP_MAP__LIMITS__STEP",
    }
    assert sources(load_config(None, {"map.limits.slope": 0.1}, one)) == {
        "map.limits.slope": "command line",
        "map.limits.step": "environment ROUGHMAP_MAP__LIMITS__STEP",
        **{f"map.limits.{name}": "default" for name in default_limits(None) if name not in ("slope", "step")},
    }
    whole = load_config(file, environ={"ROUGHMAP_MAP__LIMITS": '{"slope": 0.2}'})
    assert sources(whole) == {"map.limits.slope": "environment ROUGHMAP_MAP__LIMITS"}
    assert sources(load_config(file, {"map.limits": {}})) == {"map.limits": "command line"}


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "ROUGHMAP_MAP__CELL_SISE",
            "map.cell_sise: unknown key, did you mean cell_size? (allowed in map: name, frame_id, surface, cell_size, ",
        ),
        ("ROUGHMAP_MAPP__NAME", "mapp.name: unknown key, did you mean map? (allowed: SECTION.KEY with map, zenoh, "),
        ("ROUGHMAP_MAP", "map: unknown key"),
        ("ROUGHMAP_", "unknown key"),
        ("ROUGHMAP_MAP_NAME", "map_name: unknown key"),
        ("ROUGHMAP_MAP__NAME__X", "map.name.x: unknown key"),
        ("ROUGHMAP_KEYS__TILE", "keys.tile: unknown key"),
        ("ROUGHMAP_INPUT__MAX_POSES", "input.max_poses: is no longer a setting (always 20000 poses per robot)"),
    ],
)
def test_unknown_variables_and_keys(name: str, words: str) -> None:
    said = fault(None, environ={name: "1"})
    assert said.startswith(f"environment {name}: ")
    assert words in said
    dotted = name.removeprefix("ROUGHMAP_").lower().replace("__", ".")
    assert fault(None, {dotted: "1"}).startswith("command line: ")


def test_a_fault_names_the_source_of_the_value(file: Path, tmp_path: Path) -> None:
    environ = {"ROUGHMAP_MAP__LEVELS": "0"}
    assert fault(file, environ=environ).startswith("environment ROUGHMAP_MAP__LEVELS: map.levels: must be greater")
    assert fault(file, {"map.levels": 0}, {"ROUGHMAP_MAP__LEVELS": "3"}).startswith("command line: map.levels: must be")
    for text, words in (
        ("map.levels = 0", "map.levels: must be greater than or equal to 1; found 0"),
        ("map.cell_sise = 1", "map.cell_sise: unknown key, did you mean cell_size? (allowed: name, "),
        ("[sensors.lidar]", "sensors.lidar.range_sigma: is required"),
        ("log.keep = 5", "log.keep: must be"),
        ("map = 5", "map: must be a table"),
        (
            'map.error_model = "sphere"\nmap.levels = 0',
            "map.error_model: must be 'point', 'cuboid' or 'ellipsoid'; found",
        ),
    ):
        bad = tmp_path / "bad.toml"
        bad.write_text(text, encoding="utf-8")
        assert fault(bad).startswith(f"{bad}: {words}")
    assert fault(bad).endswith("(and 1 more)")
    assert fault(None, environ={"ROUGHMAP_ZENOH__LISTEN": "[tcp"}).endswith("zenoh.listen: must be JSON; found '[tcp'")


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    bad = tmp_path / "bad.toml"
    assert fault(bad).startswith(f"{bad}: can't be read: No such file")
    assert fault(tmp_path).startswith(f"{tmp_path}: can't be read: Is a directory")
    for content, words in (
        (b"[map\n", "invalid TOML"),
        (b"\xff\xfe", "not UTF-8 text"),
        (b"# " + b"x" * (1 << 20), "expected at most 1048576 bytes"),
        (b"a = " + b"[" * 5000, "nested too deep"),
    ):
        bad.write_bytes(content)
        assert fault(bad).startswith(f"{bad}: {words}")
