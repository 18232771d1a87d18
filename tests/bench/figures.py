"""A row of the benchmark's table, and what is common to measuring all of them."""

import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Mark:
    """What a row is held to: its value, or its ratio to the reference, at most or at least ``bound``."""

    bound: float
    of: str = "value"
    least: bool = False

    def met(self, value: float, ratio: float | None) -> bool | None:
        """None where there is nothing to judge by."""
        judged = value if self.of == "value" else ratio
        if judged is None or not np.isfinite(judged):
            return None
        return judged >= self.bound if self.least else judged <= self.bound


@dataclass(frozen=True)
class Row:
    """One figure. ``low``, ``high``: quartiles, or the median and the largest where ``value`` is a p99.

    ``unit`` is that of ``value``, ``low``, ``high`` and ``reference_value``. ``samples``, ``beside``: what the
    figure and its reference are made of.
    ``note`` also says why there is no value, where there is none.
    """

    key: str
    figure: str
    unit: str
    value: float
    low: float
    high: float
    mark: Mark | None = None
    reference: str = ""
    reference_value: float | None = None
    ratio: float | None = None
    samples: Sequence[float] = field(default=(), repr=False)
    beside: Sequence[float] = field(default=(), repr=False)
    note: str = ""

    @property
    def met(self) -> bool | None:
        """None where no mark is set, or nothing was measured."""
        return None if self.mark is None else self.mark.met(self.value, self.ratio)


def rounds_row(
    key: str,
    figure: str,
    unit: str,
    samples: Sequence[float],
    *,
    mark: Mark | None = None,
    reference: str = "",
    beside: Sequence[float] = (),
    note: str = "",
) -> Row:
    """A figure of which every round gave one value: medians, and the median of the rounds' own ratios, so that a busy
    moment falls on both sides."""
    low, value, high = np.percentile(samples, [25, 50, 75]).tolist()
    ratio = float(np.median(np.divide(samples, beside))) if len(beside) else None
    reference_value = float(np.median(beside)) if len(beside) else None
    return Row(
        key, figure, unit, value, low, high, mark, reference, reference_value, ratio, list(samples), list(beside), note
    )


def latency_row(
    key: str,
    figure: str,
    samples: Sequence[float],
    percentile: float,
    *,
    mark: Mark | None = None,
    reference: str = "",
    beside: Sequence[float] = (),
    note: str = "",
) -> Row:
    """A percentile of many latencies, in ms of ``samples`` in seconds, beside the same of the reference's."""
    ms = np.multiply(samples, 1e3)
    value, middle, quarter, three, most = np.percentile(ms, [percentile, 50, 25, 75, 100]).tolist()
    low, high = (quarter, three) if percentile == 50 else (middle, most)
    reference_value = float(np.percentile(beside, percentile)) * 1e3 if len(beside) else None
    ratio = None if reference_value is None else value / reference_value
    return Row(
        key, figure, "ms", value, low, high, mark, reference, reference_value, ratio, ms.tolist(), list(beside), note
    )


def missing_row(key: str, figure: str, unit: str, mark: Mark | None, why: str) -> Row:
    """A figure that could not be measured here."""
    return Row(key, figure, unit, float("nan"), float("nan"), float("nan"), mark, note=why)


@dataclass(frozen=True)
class Bench:
    """How the benchmark is run. ``folder``: where it keeps scans, libraries and services' files. ``data``: recordings,
    or None.
    """

    folder: Path
    quick: bool
    data: Path | None = None

    def rounds(self, number: int) -> int:
        """So many, or two where only wholeness counts."""
        return 2 if self.quick else number

    @property
    def settle_s(self) -> float:
        """An asker's start and the service's first answers, which are not counted."""
        return 0.5 if self.quick else 3.0

    def say(self, text: str) -> None:
        """Progress, on standard error."""
        print(f"bench: {text}", file=sys.stderr, flush=True)

    def interleaved(
        self,
        rounds: int,
        runs: Mapping[str, Callable[[], object]],
        *,
        both: Sequence[str] = (),
        clock: Callable[[], float] = time.perf_counter,
    ) -> dict[str, list[float]]:
        """Seconds by ``clock`` of each run in each round, all of them in turn, after one round that warms up.

        Pinned to one core, but those named in ``both``.
        """
        cores = os.sched_getaffinity(0)
        times: dict[str, list[float]] = {name: [] for name in runs}
        try:
            for turn in range(self.rounds(rounds) + 1):
                self.say(f"round {turn} of {self.rounds(rounds)}" if turn else f"{len(runs)} runs, warming up")
                for name, run in runs.items():
                    os.sched_setaffinity(0, cores if name in both else {max(cores)})
                    begun = clock()
                    run()
                    if turn:
                        times[name].append(clock() - begun)
        finally:
            os.sched_setaffinity(0, cores)
        return times
