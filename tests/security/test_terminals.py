"""What others send is shown so that no terminal obeys it, and none of it passes for a line of ours."""

from pathlib import Path

import numpy as np
import pytest
from net import open_listener
from processes import T0, Service, connected
from rich.console import Console

from roughmap_schemas import QueryError, encode_cloud, model_bytes
from roughmap_schemas.messages import MapStatus
from roughmap_service.cli.doctor.findings import Finding, show
from roughmap_service.cli.main import run
from roughmap_service.cli.top_frame import frame

TRICK = "\x1b]0;mine\x07\n12:00:00 INFO all is well\u202e\x9b2J"
"""A title for the window, a line of a log, another direction of writing, an empty screen."""


def obeyed(text: str) -> list[str]:
    """The lines that hold what prints nothing."""
    return [line for line in text.split("\n") if not line.isprintable()]


def test_a_robot_forges_no_line_of_the_log(tmp_path: Path) -> None:
    with Service(tmp_path, service={"log_format": "text"}) as service, connected(service) as feed:
        assert feed.refused("points", "rover1", encode_cloud(np.zeros((1, 3)), T0, f"lidar{TRICK}")) == "unknown_sensor"
        assert service.stop() == 0
    (line,) = [line for line in service.err if "all is well" in line]
    assert "robot rover1 sensor lidar\\x1b]0;mine\\x07\\n12:00:00" in line
    assert not obeyed("\n".join(service.err))


def test_doctor(capsys: pytest.CaptureFixture[str]) -> None:
    show([Finding("rover1", "wrong", f"clouds in {TRICK}", f"add [sensors.{TRICK}]")])
    told = capsys.readouterr().out
    assert told.count("\n") == 3
    assert not obeyed(told)


def test_an_answer_to_query(capsys: pytest.CaptureFixture[str]) -> None:
    error = model_bytes(QueryError(code=f"bad{TRICK}", message=TRICK))
    with open_listener() as (session, endpoints):
        session.declare_queryable("maps/site/region", lambda query: query.reply_err(error), complete=True)
        assert run(["query", "--bbox", "0,0,1,1", "--connect", endpoints[0]]) == 2
    told = capsys.readouterr().err
    assert "all is well" in told
    assert not obeyed(told)


def test_a_status_in_top() -> None:
    status = MapStatus(
        map=TRICK, run="0" * 32, instance=TRICK, epoch=1, version=TRICK, frame_id="map", cell_size=0.1, levels=8,
        layers=[], bounds=None, extent=None, error_model="cuboid", configuration_digest="2" * 32, health="ok",
        sequence=0, durable_sequence=0, input=0, newest_stamp_ns=0, clouds={}, points={}, poses={}, refused={},
        gaps={f"[bold]r1{TRICK}": 1}, jumps={}, lag_s={}, rates={}, memory_bytes=0, tiles={}, log={"file": TRICK},
        uptime_s=1.0,
    )  # fmt: skip
    console = Console(record=True, width=200, force_terminal=True)
    console.print(frame(status, [], 0.0))
    told = console.export_text(styles=False)
    assert "[bold]r1" in told
    assert not obeyed(told)
