"""`make soak` and `make overload`, shortened: whether they are whole. Of times nothing is asserted here."""

import sys
from pathlib import Path

import numpy as np
import pytest
from overload import Measured, main, overload
from samples import growth
from soak import RESTARTS, WARM, Soak, Soaked, judge
from soak_picture import draw

SECONDS = 8.0

RATE = 500.0
"""Scans a second of which twice as many are sent: more than machines integrate of these, so no search is needed."""


def test_twice_as_much_as_it_can_take(tmp_path: Path) -> None:
    """Everything sent is told of, no pose is lost, and it says that it is overloaded, and that it no longer is."""
    found = overload(tmp_path, SECONDS, lambda _: None, rate=RATE)
    assert not found.broken, (found.broken, found.numbers)


def test_an_overload_that_does_not_hold_ends_with_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    numbers = {"times": 1.0, "back after s": 1.0}
    monkeypatch.setattr(sys, "argv", ["overload.py"])
    for broken, slow in ((["it broke"], {}), ([], {"times": 5.1}), ([], {"back after s": None})):
        monkeypatch.setattr("overload.overload", lambda *_, b=broken, s=slow: Measured(b, {**numbers, **s}))
        assert main() == 1
        assert "BROKEN: " in capsys.readouterr().out


def test_a_soak_run_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Started three times, once after a kill; sampled, judged, drawn, replayed."""
    monkeypatch.setattr("soak.RESTARTS", (0.35, 0.6))
    found = Soak(tmp_path, 3 * SECONDS, 0.5, lambda _: None).go()
    judge(found, flat=False)
    assert not found.broken, (found.broken, found.numbers)
    assert len(found.starts) == len(RESTARTS) + 1
    assert str(found.numbers["replay"]).startswith("equal")
    assert draw(found.samples, found.starts, found.warm, tmp_path / "soak.png").stat().st_size > 10_000


def run_of(rss: np.ndarray) -> Soaked:
    """Samples in which all is flat but for the memory."""
    steady = dict.fromkeys(("descriptors", "threads", "log", "spill", "tiles", "store_a_tile", "ok"), 10.0)
    samples = [{"t": float(t), **steady, "rss": float(r), "beside_tiles": float(r)} for t, r in enumerate(rss)]
    return Soaked(samples=samples, warm=WARM * len(rss))


def test_a_leak_is_found_and_teeth_and_spikes_are_none() -> None:
    """100 KiB a sample is one; a saw of 20 MiB and a spike of a gigabyte are not."""
    t = np.arange(1000)
    flat = 3e8 + 2e7 * (t % 50) / 50
    flat[700] += 1e9
    found = run_of(flat)
    judge(found, flat=True)
    assert found.broken == []
    leaking = run_of(flat + 1e5 * t)
    judge(leaking, flat=True)
    assert len(leaking.broken) == 2
    assert leaking.broken[0].startswith("rss rose by ")


def test_growth_is_that_of_most_pairs() -> None:
    assert growth([0, 1, 2, 3], [5, 5, 5, 5]) == 0.0
    assert growth([0, 1, 2, 3, 4], [0, 2, 400, 6, 8]) == pytest.approx(8.0)
    assert growth([1.0], [3.0]) == 0.0
