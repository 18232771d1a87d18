"""What the image is made and started by fits together, as far as that can be seen without an engine."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
import zenoh

from roughmap_schemas.config_load import load_config
from roughmap_service.inputs.session import endpoints

ROOT = Path(__file__).resolve().parents[2]
DOCKER = ROOT / "docker"


def locked(path: Path) -> set[str]:
    """Each package with its version and marker."""
    return set(re.findall(r"^([a-z0-9-]+==[^\\]+?) \\$", path.read_text(), re.MULTILINE))


def settings_of(service: dict[str, Any]) -> dict[str, str]:
    return {name: value for name, value in service.get("environment", {}).items() if name.startswith("ROUGHMAP_")}


def test_the_image_has_the_versions_that_are_tested() -> None:
    image = locked(DOCKER / "requirements.lock")
    assert {"numba", "eclipse-zenoh", "mcap", "matplotlib"} <= {name.partition("==")[0] for name in image}
    assert image <= locked(ROOT / "requirements.lock")
    assert not [name for name in image if name.startswith(("pytest", "mypy", "scipy"))]


@pytest.mark.parametrize("name", ["map", "secure-map"])
def test_compose_starts_the_service_with_settings_that_it_takes(name: str) -> None:
    services = yaml.safe_load((DOCKER / "compose.yaml").read_text())["services"]
    for service in services.values():
        assert (service["read_only"], service["cap_drop"]) == (True, ["ALL"])
        assert service["pids_limit"]
        assert service["mem_limit"]
        for volume in service.get("volumes", ()):
            source = volume.partition(":")[0]
            assert not source.startswith("./") or source.startswith("./certificates") or (DOCKER / source).exists()
    loaded = load_config(DOCKER / "roughmap.toml", {}, settings_of(services[name]))
    assert loaded.config.http.listen == "0.0.0.0:8080"


PROFILES = {
    "demo": {"router", "map", "rover"},
    "router": {"router", "map"},
    "own-router-demo": {"own-router", "map", "rover"},
    "own-router": {"own-router", "map"},
    "secure-demo": {"secure-map", "secure-rover"},
    "secure": {"secure-map"},
}


def test_a_profile_of_compose_is_one_whole_thing() -> None:
    """One map each, one way in, and no port of the machine twice; nothing starts without a profile."""
    services = yaml.safe_load((DOCKER / "compose.yaml").read_text())["services"]
    assert {profile for service in services.values() for profile in service["profiles"]} == set(PROFILES)
    for profile, wanted in PROFILES.items():
        chosen = {name: service for name, service in services.items() if profile in service["profiles"]}
        assert set(chosen) == wanted
        ports = [port.split(":")[-2] for service in chosen.values() for port in service.get("ports", ())]
        assert sorted(ports) == ["7447", "8080"]


def test_the_authoritys_key_goes_into_no_container() -> None:
    services = yaml.safe_load((DOCKER / "compose.yaml").read_text())["services"]
    mounted = [volume.split(":")[0] for service in services.values() for volume in service.get("volumes", ())]
    assert "./certificates/authority.pem" in mounted
    assert not {"./certificates", "./certificates/", "./certificates/authority.key", "."} & set(mounted)


def test_the_routers_of_compose_can_be_opened_as_written() -> None:
    """By Zenoh itself, in this process, the one port aside: what zenohd -c does with the file."""
    config = zenoh.Config.from_file(str(DOCKER / "router.json5"))
    assert json.loads(config.get_json("listen/endpoints")) == ["tcp/0.0.0.0:7447"]
    config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
    config.insert_json5("adminspace/enabled", "true")
    with zenoh.open(config) as router:
        assert json.loads(config.get_json("mode")) == "router"
        assert endpoints(router)[0].startswith("tcp/127.0.0.1:")


def test_kubernetes_starts_it_with_settings_that_it_takes(tmp_path: Path) -> None:
    settings, _, stateful = yaml.safe_load_all((DOCKER / "kubernetes.yaml").read_text())
    (tmp_path / "roughmap.toml").write_text(settings["data"]["roughmap.toml"])
    (container,) = stateful["spec"]["template"]["spec"]["containers"]
    environment = {one["name"]: one["value"] for one in container["env"]}
    loaded = load_config(tmp_path / "roughmap.toml", {}, environment)
    assert loaded.config.zenoh.connect == ["tcp/zenoh-router:7447"]
    assert stateful["spec"]["replicas"] == 1, "a map has one writer"
