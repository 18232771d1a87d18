"""Dashboard and alert rules name metrics and labels that exist; a Prometheus, where there is one, runs them all."""

import json
import re
import shutil
import subprocess
import threading
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml
from http_tools import address, get, pages
from net import WAIT_S, wait_until
from served import Served

from roughmap_schemas.reasons import CloudReason, PointReason, PoseReason, QueryCode, Refusal
from roughmap_service.watch.metrics import Disk, Metrics, PartFigures
from roughmap_service.watch.readiness import Problem, Readiness, Sources

DOCKER = Path(__file__).parents[2] / "docker"
DASHBOARD = DOCKER / "grafana-dashboard.json"
ALERTS = DOCKER / "alerts.yaml"

REASONS = {
    "roughmap_clouds_rejected_total": CloudReason,
    "roughmap_points_rejected_total": PointReason,
    "roughmap_poses_rejected_total": PoseReason,
    "roughmap_messages_refused_total": Refusal,
    "roughmap_query_seconds_count": QueryCode,
    "roughmap_problem": Problem,
}
"""What the values of a metric's one label may be."""

FROM_PROMETHEUS = {"job", "instance", "le"}


def filled_metrics(served: Served, directory: Path) -> Metrics:
    """With every family that a service can show."""
    for _ in range(2):
        served.counters.gap("rover1", 1)
        served.counters.jump("rover1")
    assert served.status is not None

    def lost() -> dict[str, str]:
        return {"robot r1 sensor lidar": "a sentence"}

    return Metrics(
        served.status, served.counters, PartFigures, dict, lost, Disk(directory, directory / "map.db"), 2**31
    )


@pytest.fixture(scope="module")
def labels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """The labels of every sample by its name, as a scrape shows them."""
    with Served() as served:
        text = filled_metrics(served, tmp_path_factory.mktemp("labels")).text().decode()
    found: dict[str, set[str]] = {}
    for line in text.splitlines():
        if match := re.match(r"(\w+)(?:\{(.*)\})? ", line):
            found.setdefault(match[1], set()).update(re.findall(r'(\w+)="', match[2] or ""))
    return found


def rules() -> list[dict[str, Any]]:
    return [rule for group in yaml.safe_load(ALERTS.read_text())["groups"] for rule in group["rules"]]


def panels() -> list[dict[str, Any]]:
    return [panel for panel in json.loads(DASHBOARD.read_text())["panels"] if panel["type"] != "row"]


def expressions() -> list[str]:
    """All of both files, with the dashboard's variables put in."""
    found = [target["expr"] for panel in panels() for target in panel["targets"]] + [rule["expr"] for rule in rules()]
    for name, value in (("$__rate_interval", "1m"), ("$job", ".*"), ("$instance", ".*")):
        found = [expression.replace(name, value) for expression in found]
    return found


@pytest.mark.parametrize("expression", expressions())
def test_what_is_named_exists(expression: str, labels: dict[str, set[str]]) -> None:
    names = re.findall(r"\b((?:roughmap|process)_\w+)(?:\{([^}]*)\})?", expression)
    assert names or expression.startswith("up{"), "an expression without a metric"
    for name, matchers in names:
        assert name in labels, f"{name} is no metric of the service"
        for label, value in re.findall(r'(\w+)[=!~]+"([^"]*)"', matchers):
            assert label in labels[name] | FROM_PROMETHEUS, f"{name} has no label {label}"
            if name in REASONS and label not in FROM_PROMETHEUS:
                assert set(value.split("|")) <= {*map(str, REASONS[name]), "ok"}, f"{name}: {label} is never {value}"
    for _, grouped in re.findall(r"\b(by|on) \(([^)]*)\)", expression):
        wanted = {label.strip() for label in grouped.split(",")} - FROM_PROMETHEUS
        assert any(wanted <= labels.get(name, set()) for name, _ in names), f"no metric here has {wanted}"


def test_the_files_are_whole() -> None:
    alerts = [rule["alert"] for rule in rules()]
    assert len(set(alerts)) == len(alerts)
    for rule in rules():
        assert rule["labels"]["severity"] in {"critical", "warning", "info"}
        assert rule["annotations"].keys() == {"summary", "description"}


def test_the_dashboard_can_be_imported() -> None:
    """As Grafana takes it by its import dialog or a provisioning file: it asks for a Prometheus, and nothing else."""
    board = json.loads(DASHBOARD.read_text())
    assert board["title"]
    assert re.fullmatch(r"[a-zA-Z0-9_-]{1,40}", board["uid"])
    assert not board.keys() & {"id", "__inputs", "__requires"}, "of the Grafana that it was exported from"
    assert 36 <= board["schemaVersion"] <= 41, "data sources named by type and uid; panels of Grafana 9 and newer"
    variables = board["templating"]["list"]
    assert (variables[0]["name"], variables[0]["type"], variables[0]["query"]) == (
        "datasource",
        "datasource",
        "prometheus",
    )
    wanted = {"type": "prometheus", "uid": "${datasource}"}
    assert all(variable["datasource"] == wanted for variable in variables[1:])
    declared, text = {variable["name"] for variable in variables}, DASHBOARD.read_text()
    assert set(re.findall(r"\$\{?([a-z]\w*)", text)) == declared, "variables that are used, and those that there are"

    everything = board["panels"]
    assert len({panel["id"] for panel in everything}) == len(everything)
    cells: set[tuple[int, int]] = set()
    for panel in everything:
        place = panel["gridPos"]
        assert place["x"] + place["w"] <= 24
        taken = {(place["x"] + i, place["y"] + j) for i in range(place["w"]) for j in range(place["h"])}
        assert not cells & taken, f"{panel['title']} lies over another"
        cells |= taken
    for panel in panels():
        assert panel["title"]
        assert panel["datasource"] == wanted
        assert all(target["datasource"] == wanted and target["expr"] for target in panel["targets"])
        assert len({target["refId"] for target in panel["targets"]}) == len(panel["targets"])


def installed(program: str, config: pytest.Config) -> str:
    """The path of a program of Prometheus; without it the test is skipped, or fails with --require-prometheus."""
    path = shutil.which(program)
    if path is None:
        report = pytest.fail if config.getoption("--require-prometheus") else pytest.skip
        report(f"{program} is not installed (Debian: prometheus)")
    return path


def test_promtool_finds_no_fault(pytestconfig: pytest.Config) -> None:
    promtool = installed("promtool", pytestconfig)
    done = subprocess.run([promtool, "check", "rules", str(ALERTS)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    with Served() as served, pages(Sources(Readiness(), metrics=filled_metrics(served, DOCKER).text)) as server:
        scrape = get(server, "/metrics")[2]
    done = subprocess.run([promtool, "check", "metrics"], input=scrape, capture_output=True, check=False)
    assert (done.returncode, done.stdout) == (0, b""), (done.stdout + done.stderr).decode()


@contextmanager
def prometheus(program: str, directory: Path, target: str) -> Iterator[str]:
    """A real one that scrapes `target` with our rules; its address, once it listens."""
    config = {
        "global": {"scrape_interval": "200ms", "scrape_timeout": "200ms", "evaluation_interval": "200ms"},
        "rule_files": [str(ALERTS)],
        "scrape_configs": [{"job_name": "roughmap", "static_configs": [{"targets": [target]}]}],
    }
    (directory / "prometheus.yml").write_text(yaml.safe_dump(config))
    with subprocess.Popen(
        [program, f"--config.file={directory / 'prometheus.yml'}", f"--storage.tsdb.path={directory / 'data'}",
         "--web.listen-address=127.0.0.1:0"],
        stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            lines = iter(process.stderr or ())
            where = next(found[1] for line in lines if (found := re.search(r'"Listening on" address=(\S+)', line)))
            reader = threading.Thread(target=lambda: list(lines))  # so that it never waits to be read
            reader.start()
            yield where
            process.terminate()
            reader.join(WAIT_S)
        finally:
            process.kill()


def asked(where: str, path: str, **parameters: str) -> Any:
    url = f"http://{where}/api/v1/{path}?{urllib.parse.urlencode(parameters)}"
    try:
        with urllib.request.urlopen(url, timeout=WAIT_S) as response:
            return json.load(response)["data"]
    except urllib.error.HTTPError as error:
        if error.code == 503:  # it listens, and is not ready yet
            return None
        raise AssertionError(f"{parameters}: {error.read().decode()}") from None


def test_a_real_prometheus_scrapes_and_runs_every_expression(tmp_path: Path, pytestconfig: pytest.Config) -> None:
    program = installed("prometheus", pytestconfig)
    with Served() as served:
        served.counters.cloud("integrated", 1000, {}, None, 0.01)
        sources = Sources(Readiness(), metrics=filled_metrics(served, tmp_path).text)
        with pages(sources) as server, prometheus(program, tmp_path, ":".join(map(str, address(server)))) as where:

            def value(query: str) -> float | None:
                found = asked(where, "query", query=query)
                return float(found["result"][0]["value"][1]) if found and found["result"] else None

            wait_until(lambda: value('up{job="roughmap"}') == 1, "a scrape")
            assert value("roughmap_points_accepted_total") == 1000
            for expression in expressions():
                assert asked(where, "query", query=expression) is not None, expression

            def evaluated() -> list[dict[str, Any]]:
                found = [rule for group in asked(where, "rules")["groups"] for rule in group["rules"]]
                return found if all(rule["health"] != "unknown" for rule in found) else []

            told = wait_until(evaluated, "every rule to be evaluated")
            assert {rule["name"] for rule in told} == {rule["alert"] for rule in rules()}
            assert [(rule["name"], rule.get("lastError")) for rule in told if rule["health"] != "ok"] == []
