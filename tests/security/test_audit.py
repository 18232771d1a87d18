"""What a build may bring in: each package pinned, each file by its hash, from no index of the lock's own; no known
unsafe habit in our code."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

from net import WAIT_S

ROOT = Path(__file__).parents[2]


def locked() -> dict[str, str]:
    """Package -> all that the lock says of it."""
    text = re.sub(r"\\\n", " ", (ROOT / "requirements.lock").read_text())
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    return {re.split(r"[=\[ ;]", line)[0]: line for line in lines}


def test_the_lock_pins_all_by_hash_and_names_no_index() -> None:
    assert len(locked()) > 50
    for name, line in locked().items():
        assert re.match(rf"{re.escape(name)}(\[[a-z,-]+\])?==[0-9][^\s;]*( ;[^-]*)?\s+--hash=sha256:", line), line[:200]
        assert re.findall(r"--(?!hash)\S*", line) == [], "a package's own option"
        assert re.findall(r"--hash=(?!sha256:[0-9a-f]{64}(?:\s|$))", line) == []
    assert "://" not in (ROOT / "requirements.lock").read_text()


def test_the_lock_holds_all_that_is_asked_for() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    for wanted in [*project["dependencies"], *extras["dev"]]:
        assert re.split(r"[><=\[ ;]", wanted)[0] in locked()


def test_bandit_finds_nothing() -> None:
    command = [
        sys.executable,
        "-m",
        "bandit",
        "-q",
        "-c",
        "pyproject.toml",
        "-r",
        "roughmap",
        "schemas",
        "service",
        "docker",
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=4 * WAIT_S, check=False)
    assert done.returncode == 0, done.stdout


def test_an_audit_that_reaches_nobody_says_so_last(tmp_path: Path) -> None:
    nowhere = dict.fromkeys(("HTTPS_PROXY", "https_proxy"), "http://127.0.0.1:9") | {"PIP_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, ".ci/audit"], cwd=ROOT, capture_output=True, text=True, timeout=4 * WAIT_S, check=False,
        env={**os.environ, **nowhere},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert re.match("NOTHING AUDITED: .*pypi is not reachable .*osv is not reachable", done.stdout.splitlines()[-1])
