"""The exported JSON Schemas: true to the models, and real instances hold to them."""

import json
import shutil
from pathlib import Path

import pytest
from json_samples import EVENTS, SAMPLES
from schema_check import at_pointer, faults, subschemas

from roughmap_schemas import CloudReason, Config, QueryCode, config_from, encode_event, export, model_bytes

FILES = {path.stem: path for path in export.FOLDER.glob("*.json")}
SENSOR = {"range_sigma": 0.02, "max_range": "inf", "exclude": [[0, 0, 0, 1, 1, 1]]}


def schema(name: str) -> dict:
    return json.loads(FILES[name].read_text(encoding="utf-8"))


def test_the_files_are_up_to_date() -> None:
    assert Path(__file__).parents[2] / "schemas" / "json" == export.FOLDER
    assert export.stale(export.FOLDER) == []
    assert set(FILES) == {*SAMPLES, "Config", "Event", "QueryCode", "Reason"}


@pytest.mark.parametrize("name", FILES)
def test_the_files_are_json_schemas(name: str) -> None:
    def never(word: str) -> None:
        raise AssertionError(f"{word} in JSON")

    root = json.loads(FILES[name].read_text(encoding="utf-8"), parse_constant=never)
    assert root["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert root["title"] == name
    for one in subschemas(root):
        faults(None, one, root)  # no keyword that the validator doesn't know
        assert set(one.get("required", ())) <= one.get("properties", {}).keys()
        if "$ref" in one:
            assert isinstance(at_pointer(root, one["$ref"]), dict)


@pytest.mark.parametrize("name", SAMPLES)
def test_instances_hold_to_them(name: str) -> None:
    root, value = schema(name), json.loads(model_bytes(SAMPLES[name]))
    assert faults(value, root, root) == []
    assert faults({**value, "more": 1}, root, root) == [], "a later minor release may add it"
    assert set(root["required"]) == set(value), "all is always written"
    for member in root["required"]:
        assert faults({key: item for key, item in value.items() if key != member}, root, root)


@pytest.mark.parametrize("event", EVENTS, ids=lambda event: event.kind)
def test_events_hold_to_them(event: object) -> None:
    root, value = schema("Event"), json.loads(encode_event(event))
    assert faults(value, root, root) == []
    assert faults({**value, "kind": "edit"}, root, root)
    assert faults({**value, "sequence": -1}, root, root)
    assert faults({**value, "more": 1}, root, root)


def test_words() -> None:
    for name, words in (("QueryCode", QueryCode), ("Reason", CloudReason)):
        root = schema(name)
        assert all(faults(str(word), root, root) == [] for word in words)
        assert faults("nonsense", root, root)


def test_settings_hold_to_them() -> None:
    """What may be read, in the forms in which JSON and TOML write it, and what `public_dict` gives."""
    root = schema("Config")
    config = config_from({"sensors": {"lidar": SENSOR}, "robots": {"r1": {"sensors": {"lidar": SENSOR}}}}, "test")
    assert faults(config.public_dict(), root, root) == []
    assert faults(Config().public_dict(), root, root) == []
    for good in (
        {},
        {"map": {"memory_limit": "1GiB", "bounds": [0, 0, 1, 1]}, "input": {"max_message": 1000}},
        {"zenoh": {"listen": "", "connect": ["tcp/localhost:7447"]}, "store": {"path": ""}, "map": {"bounds": ""}},
        {"sensors": {"lidar": {"range_sigma": 0.02, "max_range": "inf", "ceiling": 2.0}}},
        {"sensors": {"lidar": SENSOR}, "robots": {"r1": {"sensors": {"lidar": {"translation": [0, 0, 1]}}}}},
    ):
        config_from(good, "test")
        assert faults(good, root, root) == [], good
    for bad in (
        {"mapp": {}},
        {"map": {"cell_sise": 0.1}},
        {"map": {"cell_size": 0}},
        {"map": {"name": "a b"}},
        {"map": {"bounds": [0, 0, 1]}},
        {"sensors": {"lidar": {}}},
        {"sensors": {"lidar": {"range_sigma": 0.02, "max_range": 0}}},
        {"robots": {"r1": {"sensors": {"lidar": {"tilt": 1}}}}},
        {"input": {"pose_sigma": [1, 2, 3]}},
        {"log": {"compression": "gzip"}},
    ):
        assert faults(bad, root, root), bad


def test_writing_them_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert export.main(["--folder", str(tmp_path / "json")]) == 0
    assert {path.name: path.read_bytes() for path in (tmp_path / "json").iterdir()} == {
        path.name: path.read_bytes() for path in FILES.values()
    }
    assert "Receipt.json: written" in capsys.readouterr().err
    assert export.main(["--folder", str(tmp_path / "json")]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("change", ["altered", "missing", "foreign"])
def test_check_tells_what_is_not_up_to_date(change: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "json"
    shutil.copytree(export.FOLDER, folder)
    arguments = ["--check", "--folder", str(folder)]
    assert export.main(arguments) == 0
    name = "Foreign.json" if change == "foreign" else "Receipt.json"
    if change == "missing":
        (folder / name).unlink()
    else:
        text = (folder / "Receipt.json").read_text(encoding="utf-8")
        (folder / name).write_text(text.replace('"integer"', '"number"'), encoding="utf-8")
    assert export.main(arguments) == 1
    said = capsys.readouterr().err
    assert f"{folder / name}: out of date" in said
    assert "python -m roughmap_schemas.export" in said
    assert export.main(arguments[1:]) == 0
    assert export.main(arguments) == 0
