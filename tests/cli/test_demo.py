"""`roughmap demo`: the whole job with service, rover, planner and replay ends as equal, with table and pictures."""

import json
import re
from pathlib import Path

import pytest

from roughmap_schemas.layers import LAYERS
from roughmap_schemas.messages import MapStatus
from roughmap_service.cli.demo.steps import differences
from roughmap_service.cli.main import run

PICTURES = ["height.png", "traversability.png", "confidence.png"]
EQUAL = re.compile(r"equal: [1-9]\d* checkpoints, sequence \d+, digest [0-9a-f]{32}")


class Patient:
    """A planner that heard no error."""

    errors: list[str] = []  # noqa: RUF012


def test_it_ends_as_equal_with_a_table_and_pictures(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "demo"
    code = run(["demo", "--seconds", "4", "--out", str(out)])
    table, steps = capfd.readouterr()
    assert code == 0, table + steps
    lines = table.strip().splitlines()
    assert sum(bool(EQUAL.fullmatch(line)) for line in lines) == 1
    rows = dict(re.split(r"\s{2,}", line, maxsplit=1) for line in lines[: lines.index("")])
    assert re.fullmatch(r"\d+ of 40 integrated.*", rows["scans"])
    assert int(rows["points"].split()[0].replace(",", "")) > 100_000
    for name in ("rate", "scan to queryable", "query of 20 x 20 m", "map", "log", "replay", "total time"):
        assert re.search(r"\d", rows[name]), name
    # Half of the rover's heights err by its pose (1 cm in z) and little more: a slip of frames, mounting or deskewing
    # makes decimetres of it.
    height_error = re.match(r"median ([\d.]+) cm, p95 ([\d.]+) cm", rows["height error"])
    assert height_error is not None
    assert float(height_error[1]) < 4
    # 18 cm were measured after so short a drive, on a busy machine.
    assert float(height_error[2]) < 25
    assert ("95 % interval" in rows) == ("interval_95" in LAYERS)
    for name in ("wrongly free", "wrongly forbidden"):
        assert re.match(r"[\d.]+% of [\d,]+ ", rows[name]), name
    assert max(map(len, lines[: lines.index("")])) <= 80
    for name in PICTURES:
        assert (out / name).read_bytes().startswith(b"\x89PNG")
        assert str(out / name) in table
    assert list((out / "log").glob("*.mcap"))
    assert [line.partition("] ")[2].split()[0] for line in steps.splitlines() if "compiling" not in line] == [
        "starting", "service", "stopping", "replaying", "comparing"
    ]  # fmt: skip


def test_json_of_two_robots_and_an_earlier_demo_s_folder(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "demo.toml").write_text("")  # the mark of an earlier demo
    (tmp_path / "height.png").write_text("an earlier one's")
    (tmp_path / "notes.txt").write_text("mine")
    code = run(["demo", "--seconds", "2", "--robots", "2", "--out", str(tmp_path), "--json"])
    out, err = capfd.readouterr()
    assert code == 0, out + err
    result = json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert result["equal"] is True
    assert result["differences"] == []
    assert (result["robots"], result["scans_published"]) == (2, 40)
    assert result["scans_integrated"] > 0
    assert result["driving_s"] >= 1.9  # the last scan is sent a tenth of a second before the end
    assert result["points_per_s"] == pytest.approx(result["points"] / result["driving_s"])
    assert EQUAL.fullmatch(result["replay_line"])
    assert all(Path(picture).read_bytes().startswith(b"\x89PNG") for picture in result["pictures"])
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_folder_of_other_things_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    code = run(["demo", "--out", str(tmp_path)])
    out, err = capsys.readouterr()
    assert (code, out) == (2, "")
    assert "holds other files; name another folder" in err
    assert err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_folder_that_cannot_be_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    assert run(["demo", "--out", str(tmp_path / "file" / "demo")]) == 2
    told = f"--out: {tmp_path / 'file' / 'demo'} is not writable: Not a directory; name another folder"
    assert capsys.readouterr().err == f"roughmap: {told}\n"


@pytest.mark.parametrize(
    ("exit_code", "replay_code", "line", "health", "known", "said"),
    [
        (0, 0, "equal: 3 checkpoints, sequence 7, digest " + "0" * 32, "ok", 5, []),
        (1, 0, "equal: 3 checkpoints, sequence 7, digest " + "0" * 32, "ok", 5, ["exit code 1"]),
        (0, 1, "differs at sequence 4: accepted 9, logged 10", "ok", 5, ["differs at sequence 4"]),
        (0, 0, "equal: 3 checkpoints, sequence 6, digest " + "0" * 32, "ok", 5, ["at sequence 7, its replay at 6"]),
        (0, 0, "equal: 3 checkpoints, sequence 7, digest " + "0" * 32, "overloaded", 5, []),
        (0, 0, "equal: 3 checkpoints, sequence 7, digest " + "0" * 32, "degraded", 5, ["degraded"]),
        (0, 0, "equal: 3 checkpoints, sequence 7, digest " + "0" * 32, "ok", 0, ["no cell"]),
    ],
)
def test_what_differs_is_found(
    exit_code: int, replay_code: int, line: str, health: str, known: int, said: list[str]
) -> None:
    status = MapStatus.model_construct(sequence=7, health=health)
    found = differences(status, Patient(), exit_code, replay_code, line, known)  # type: ignore[arg-type]
    assert len(found) == len(said)
    assert all(part in text for part, text in zip(said, found, strict=True))
