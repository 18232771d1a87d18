"""How the times of a sensor's points are read: the right form or none, over the whole kind of what drivers send."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, note
from hypothesis import strategies as st
from properties import examples

from roughmap_schemas import NO_TIMES, Cloud, TimeField, TimeForm, contract_timed, timed
from roughmap_service.run.point_times import NAMES, Ambiguous, find_form, misfit

S = 10**9
T0 = 1_700_000_000 * S
UNITS = {"s": S, "ms": 10**6, "us": 10**3, "ns": 1}
LONG = 2000
"""Points of a sweep that is seen whole."""


def cloud(stamp_ns: int, values: np.ndarray | None, name: str = "t", **more: np.ndarray) -> Cloud:
    fields = {} if values is None else {name: values}
    number = len(values) if values is not None else 10
    return Cloud(
        "lidar",
        stamp_ns,
        np.ones((number, 3), np.float32),
        time_fields=tuple(TimeField(n, v) for n, v in (fields | more).items()),
    )


def form_of(clouds: list[Cloud], *settings: Any, **more: Any) -> TimeForm | Ambiguous | None:
    return find_form([(c.stamp_ns, c.time_fields) for c in clouds], *settings, **more)


def written(times_ns: np.ndarray, stamp_ns: int, dtype: str, unit: str, origin: str) -> np.ndarray:
    """Times in ns since the epoch as a driver writes them, rounded to the type. An "end" stamp is the sweep's end."""
    after = times_ns if origin == "absolute" else times_ns - stamp_ns
    if dtype[1] == "f":
        whole, rest = np.divmod(after, UNITS[unit])
        return (whole.astype(np.float64) + rest / UNITS[unit]).astype(dtype)
    return np.rint(after / UNITS[unit]).astype(np.int64).astype(dtype)


def resolution_ns(values: np.ndarray, unit: str) -> float:
    """By how much times may be off: half a step of the type, and the rounding of two products."""
    step = 1.0 if values.dtype.kind in "ui" else float(np.spacing(np.abs(values).max()))
    return 1.01 * step * UNITS[unit] + 1.0


@dataclass
class Sweeps:
    """Clouds of one sensor, the true times of their points, and which have no time of their own."""

    clouds: list[Cloud]
    true: list[np.ndarray]
    strays: list[np.ndarray]
    off_ns: float
    form: TimeForm


@st.composite
def sweeps(draw: st.DrawFn, fewest: int = 2, clean: bool = False) -> Sweeps:
    """Five clouds as a driver may send them."""
    dtype, unit, origin = draw(
        st.sampled_from(
            [("<u4", u, "start") for u in ("ms", "us", "ns")]
            + [("<i4", u, o) for u in ("ms", "us", "ns") for o in ("start", "end")]
            + [(f, u, o) for f in ("<f4", "<f8") for u in UNITS for o in ("start", "end")]
            + [("<f8", u, "absolute") for u in UNITS]
        )
    )
    name = draw(st.sampled_from(NAMES))
    period = draw(st.floats(0.005, 0.5))
    sweep = period * draw(st.floats(0.4, 1.0))
    number = draw(st.integers(fewest, 3 * LONG))
    noise = 0.0 if clean else draw(st.sampled_from([0.0, 1e-6, 1e-4]))
    lost = 0.0 if clean else draw(st.sampled_from([0.0, 0.1, 0.2]))
    wrapped = dtype == "<u4" and draw(st.booleans())
    first = number if clean else draw(st.integers(2, number))  # the first sweep may be cut off
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    clouds, true, strays, worst = [], [], [], 0.0
    for k in range(5):
        begin = T0 + round((k + 0.01 * random.random()) * period * S)
        at = np.linspace(0.0, sweep, number) + noise * random.standard_normal(number)
        times = begin + np.rint(at * S).astype(np.int64)
        if k == 0:
            times = times[:first]
        if origin == "end":
            stamp = begin + round(sweep * S)
        else:
            stamp = begin
            times = np.maximum(times, begin) if dtype == "<u4" else times
        values = written(times, stamp, dtype, unit, origin)
        worst = max(worst, resolution_ns(values, unit))
        stray = random.random(len(values)) < lost
        stray[: len(values) // 2] &= len(values) > 10  # few points are all good, or too few are
        if len(values) <= 10:
            stray[:] = False
        if wrapped:
            values[stray] = (2**32 - 1 - random.integers(0, 10_000, int(stray.sum()))).astype(dtype)
        elif dtype[1] == "f":
            values[stray] = random.choice([np.nan, np.inf, 0.0], int(stray.sum()))
        else:
            values[stray] = 0
        clouds.append(cloud(stamp, values, name))
        true.append(times)
        strays.append(stray)
    return Sweeps(clouds, true, strays, worst, TimeForm(name, unit, origin))


def decided(clouds: list[Cloud]) -> TimeForm | Ambiguous:
    """What comes out after as many clouds as are needed."""
    for number in range(1, len(clouds) + 1):
        form = form_of(clouds[:number])
        if form is not None:
            return form
    raise AssertionError("five clouds bring a decision")


def check_times(sent: Sweeps, form: TimeForm) -> None:
    for raw, true, stray in zip(sent.clouds, sent.true, sent.strays, strict=True):
        got = timed(raw, form)
        assert got.offsets_ns is not None
        assert got.time_fields == ()
        good = (got.offsets_ns >= 0) & ~stray
        assert good.sum() == (~stray).sum()
        assert np.abs(got.stamp_ns + got.offsets_ns - true)[good].max(initial=0) <= sent.off_ns
        assert not misfit(raw, form) or len(raw.points) < LONG


@examples(300)
@given(sweeps())
def test_never_a_wrong_form(sent: Sweeps) -> None:
    """Few points or many, noise, strays, a first sweep cut off: the right times come out, or nothing."""
    form = decided(sent.clouds)
    note(f"{form} for {sent.form}")
    if isinstance(form, TimeForm):
        check_times(sent, form)


@examples(150)
@given(sweeps(fewest=LONG, clean=True))
def test_whole_sweeps_are_read(sent: Sweeps) -> None:
    form = decided(sent.clouds)
    steps = max(float(np.ptp(raw.time_fields[0].values.astype(float))) for raw in sent.clouds)
    if sent.clouds[0].time_fields[0].values.dtype.kind != "f" and steps < 20:
        return  # whole milliseconds, and few of them
    if sent.form.unit in ("s", "ms") and sent.form.origin == "start" and 0.85 < steps < 1.1:
        return  # may be shares of a sweep
    assert isinstance(form, TimeForm), form
    assert (form.field, form.unit) == (sent.form.field, sent.form.unit)
    check_times(sent, form)


N = 6000
AFTER = np.linspace(0.0, 0.0999, N)
END_NS = 99_900_000


@pytest.mark.parametrize(
    ("name", "dtype", "values", "stamp", "expected"),
    [
        ("t", "<u4", AFTER * 1e9, 0, TimeForm("t", "ns", "start")),
        ("t", "<i4", AFTER * 1e9, 0, TimeForm("t", "ns", "start")),
        ("t", "<f4", AFTER - 0.0999, END_NS, TimeForm("t", "s", "end")),
        ("t", "<f4", AFTER - 0.0993, END_NS - 600_000, TimeForm("t", "s", "end")),
        ("t", "<f4", AFTER - 0.04, 40_000_000, TimeForm("t", "s", "start")),  # stamped in the middle
        ("time", "<f4", AFTER, 0, TimeForm("time", "s", "start")),
        ("timestamp", "<f8", 1.7e9 + AFTER, 0, TimeForm("timestamp", "s", "absolute")),
        ("t", "<f8", 1.7e9 + AFTER, 0, TimeForm("t", "s", "absolute")),
        ("timestamp", "<f8", 1.7e18 + AFTER * 1e9, 0, TimeForm("timestamp", "ns", "absolute")),
        ("ts", "<f8", 1.7e15 + AFTER * 1e6, END_NS, TimeForm("ts", "us", "absolute")),
        ("offset_time", "<u4", AFTER * 1e9, 0, TimeForm("offset_time", "ns", "start")),
        ("t", "<u4", AFTER * 1e6, 0, TimeForm("t", "us", "start")),
        ("time_stamp", "<f4", AFTER * 1e3, 0, TimeForm("time_stamp", "ms", "start")),
    ],
)
def test_what_drivers_send_is_known_by_the_first_sweep(
    name: str, dtype: str, values: np.ndarray, stamp: int, expected: TimeForm
) -> None:
    """Whatever the form, the sweep begins at T0."""
    raw = cloud(T0 + stamp, (np.rint(values) if dtype[1] in "ui" else values).astype(dtype), name, ring=AFTER)
    assert form_of([raw]) == expected
    got = timed(raw, expected)
    off = resolution_ns(raw.time_fields[0].values, expected.unit)
    assert abs(got.stamp_ns - T0) <= off
    assert np.abs((got.stamp_ns - T0) + got.offsets_ns - AFTER * 1e9).max() <= off
    assert not misfit(raw, expected)


def test_an_exact_type_gives_exact_times() -> None:
    """The earliest point is the stamp; the rest are integers after it."""
    raw = cloud(T0 + 5, np.array([7, 3, 100_000_003, 50], "<u4"))
    got = timed(raw, TimeForm("t", "ns", "start"))
    assert (got.stamp_ns, got.offsets_ns.tolist()) == (T0 + 8, [4, 0, 100_000_000, 47])
    got = timed(raw, TimeForm("t", "ns", "start"), 1000)
    assert (got.stamp_ns, got.offsets_ns.tolist()) == (T0 + 1008, [4, 0, 100_000_000, 47])
    absolute = cloud(T0 + 12_345, np.array([T0, T0 + 256, T0 + 99_999_744], "<f8"))
    got = timed(absolute, TimeForm("t", "ns", "absolute"), -7)
    assert (got.stamp_ns, got.offsets_ns.tolist()) == (T0 - 7, [0, 256, 99_999_744])


def test_positive_times_with_the_stamp_at_the_end() -> None:
    """The latest point lies at the stamp."""
    raw = cloud(T0, np.array([0, 40_000_000, 100_000_000, 2**32 - 5], "<u4"))
    assert form_of([raw], "auto", "auto", "end") == TimeForm("t", "ns", "end")
    got = timed(raw, TimeForm("t", "ns", "end"))
    assert (got.stamp_ns, got.offsets_ns.tolist()) == (T0 - 100_000_000, [0, 40_000_000, 100_000_000, -1])


@pytest.mark.parametrize(
    ("form", "values", "expected"),
    [
        (
            TimeForm("t", "s", "start"),
            [0.0, np.nan, np.inf, -np.inf, 0.5, 1.5, -0.2, 1e300],
            [0, -1, -1, -1, 5 * 10**8, -1, -1, -1],
        ),
        (TimeForm("t", "s", "end"), [-0.5, np.nan, 0.0, 0.2, -1.5], [0, -1, 5 * 10**8, -1, -1]),
        (
            TimeForm("t", "s", "absolute"),
            [1.7e9, 1.7e9 + 0.5, 0.0, np.nan, 1.7e9 + 0.25],
            [0, 5 * 10**8, -1, -1, 25 * 10**7],
        ),
        (TimeForm("t", "ms", "start"), [-50.0, 0.0, 960.0], [0, 5 * 10**7, -1]),  # over 1 s after the earliest
        (TimeForm("t", "s", "start"), [np.nan, 7.0], [-1, -1]),
        (TimeForm("t", "s", "absolute"), [np.nan, np.nan], [-1, -1]),
        (TimeForm("t", "s", "end"), [np.nan, np.nan], [-1, -1]),
        (TimeForm("other", "s", "start"), [0.0, 0.1], [-1, -1]),
        (NO_TIMES, [0.0, 0.1], None),
    ],
)
def test_times_that_are_off(form: TimeForm, values: list[float], expected: list[int] | None) -> None:
    got = timed(cloud(T0, np.array(values, "<f8")), form)
    assert (None if got.offsets_ns is None else got.offsets_ns.tolist()) == expected


@pytest.mark.parametrize("stamp", [0, 50_000_000, 2**32 * S - 1])
@pytest.mark.parametrize("offset", [0, -(10**12), 10**12])
@pytest.mark.parametrize("origin", ["start", "end", "absolute"])
def test_stamps_stay_where_stamps_may_be(stamp: int, offset: int, origin: Any) -> None:
    got = timed(cloud(stamp, np.linspace(-0.1, 0.1, 21)), TimeForm("t", "s", origin), offset)
    assert 0 <= got.stamp_ns < 2**32 * S
    assert (got.stamp_ns + got.offsets_ns < 2**32 * S).all()
    none = timed(cloud(stamp, None), NO_TIMES, offset)
    assert 0 <= none.stamp_ns < 2**32 * S


@pytest.mark.parametrize("dtype", ["u1", "i1", "<u2", "<i2", "<u4", "<i4", "<f4", "<f8"])
@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("origin", ["start", "end", "absolute"])
def test_extremes_of_every_type(dtype: str, unit: Any, origin: Any) -> None:
    info = np.iinfo(dtype) if dtype.strip("<")[0] in "ui" else np.finfo(dtype)
    raw = cloud(T0, np.array([info.min, info.max, 0, 1], dtype))
    got = timed(raw, TimeForm("t", unit, origin))
    assert ((got.offsets_ns >= -1) & (got.offsets_ns <= S)).all()
    assert isinstance(form_of([raw], last=True), TimeForm | Ambiguous)


@pytest.mark.parametrize("values", [np.zeros(3), np.full(3, 5.0), np.full(3, np.nan)])
def test_equal_times_are_none(values: np.ndarray) -> None:
    """A few equal ones may be one firing of the scanner."""
    few = [cloud(T0 + k * S // 10, values.astype("<f4"), "time") for k in range(5)]
    assert form_of(few[:1]) is None
    assert form_of(few[:4]) is None
    assert form_of(few) == NO_TIMES
    assert form_of(few[:1], last=True) == NO_TIMES
    assert form_of([cloud(T0, np.repeat(values, 1000).astype("<f4"))]) == NO_TIMES


def test_no_field_is_none_at_once() -> None:
    assert form_of([cloud(T0, None, intensity=AFTER)]) == NO_TIMES
    assert form_of([cloud(T0, AFTER, "angle")]) == NO_TIMES
    assert form_of([cloud(T0, AFTER)], "none") == NO_TIMES
    assert form_of([]) is None


def test_points_without_a_return_may_all_have_time_0() -> None:
    values = np.where(np.arange(N) % 7 == 0, AFTER * 1e9, 0).astype("<u4")
    assert form_of([cloud(T0, values)]) == TimeForm("t", "ns", "start")


@pytest.mark.parametrize("period", [0.05, 0.1, 0.5, 2.0])
@pytest.mark.parametrize("dtype", ["<f4", "<f8"])
def test_shares_of_a_sweep_are_not_times(dtype: str, period: float) -> None:
    clouds = [cloud(T0 + round(k * period * S), np.linspace(0.0, 1.0, N).astype(dtype)) for k in range(5)]
    assert form_of(clouds[:1]) is None
    found = form_of(clouds)
    assert isinstance(found, Ambiguous)
    assert found.seen == (
        f"t ({np.dtype(dtype).name}) from {found.seen.split()[3]} to {found.seen.split()[5]} "
        f"clouds {period:.3g} s apart: looks like shares of a sweep, not times"
    )
    assert form_of(clouds, "t", "s", "start") == TimeForm("t", "s", "start")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.linspace(0, 5.0, N), "fits no form"),
        (1234.5 + AFTER, "fits no form"),  # a clock of the sensor's own
        (np.linspace(0, 255, N).astype("u1"), "uint8"),
        ((np.arange(N) % 2).astype("<u4"), "from 0 to 1"),
        ((AFTER * 1e6).astype("<u2"), "uint16"),  # runs over
        (3e8 + AFTER * 1e9, "fits no form"),  # within a second of its own
    ],
)
def test_what_fits_nothing_is_told(values: np.ndarray, words: str) -> None:
    clouds = [cloud(T0 + k * S // 10, values) for k in range(5)]
    assert form_of(clouds[:4]) is None
    found = form_of(clouds)
    assert isinstance(found, Ambiguous)
    assert words in found.seen


def test_two_fields_that_agree_and_two_that_do_not() -> None:
    absolute = T0 / 1e9 + AFTER
    assert form_of([cloud(T0, absolute, "timestamp", t=np.rint(AFTER * 1e9).astype("<u4"))]) == TimeForm(
        "t", "ns", "start"
    )
    clouds = [
        cloud(T0 + k * S // 10, absolute + k / 10 + 0.5, "timestamp", t=np.rint(AFTER * 1e9).astype("<u4"))
        for k in range(5)
    ]
    assert form_of(clouds[:1]) is None
    found = form_of(clouds)
    assert isinstance(found, Ambiguous)
    assert "t in ns (start) or timestamp in s (absolute)" in found.seen
    assert form_of(clouds, "timestamp") == TimeForm("timestamp", "s", "absolute")


def test_settings_narrow_the_search() -> None:
    few = [cloud(T0, np.array([0, 30, 60], "<u4"), "ticks")]
    assert form_of(few) == NO_TIMES, "not a name that is looked for"
    assert form_of(few, "ticks", "ms") == TimeForm("ticks", "ms", "start")
    assert form_of(few, "ticks", "ms", "end") == TimeForm("ticks", "ms", "end")
    assert form_of([], "ticks", "ms", "start") == TimeForm("ticks", "ms", "start")
    missing = form_of(few, "tick")
    assert isinstance(missing, Ambiguous)
    assert missing.seen == "no field tick, but ticks"
    far = [cloud(T0, 1e6 + AFTER)]
    assert form_of(far, "auto", "s", "absolute") == TimeForm("t", "s", "absolute")


def test_another_form_than_before_is_noticed() -> None:
    nanoseconds, seconds = TimeForm("t", "ns", "start"), TimeForm("t", "s", "start")
    whole = {
        "ns": cloud(T0, (AFTER * 1e9).astype("<u4")),
        "us": cloud(T0, (AFTER * 1e6).astype("<u4")),
        "s": cloud(T0, AFTER.astype("<f4")),
        "end": cloud(T0, (AFTER - 0.3).astype("<f4")),
        "named": cloud(T0, AFTER.astype("<f4"), "time"),
        "none": cloud(T0, None),
        "equal": cloud(T0, np.zeros(N, "<f4")),
    }
    assert [name for name, raw in whole.items() if misfit(raw, nanoseconds)] == [
        "us",
        "s",
        "end",
        "named",
        "none",
        "equal",
    ]
    assert [name for name, raw in whole.items() if misfit(raw, seconds)] == [
        "ns",
        "us",
        "end",
        "named",
        "none",
        "equal",
    ]
    assert [name for name, raw in whole.items() if misfit(raw, NO_TIMES)] == ["ns", "us", "s", "end", "named"]
    assert not misfit(cloud(T0, np.empty(0, "<u4")), seconds)


@examples(200)
@given(
    st.sampled_from(["<u4", "<f4", "<f8"]),
    st.lists(st.integers(-(10**8), 2 * 10**9), min_size=1, max_size=30),
)
def test_before_times_were_read_so(dtype: str, numbers: list[int]) -> None:
    """The reader of logs of rules 1: field t alone, the stamp stays, each point by itself."""
    given_numbers = np.array(numbers)
    values = np.maximum(given_numbers, 0).astype(dtype) if dtype == "<u4" else (given_numbers / 1e9).astype(dtype)
    got = contract_timed(cloud(T0, values))
    expected = [
        (int(v) if dtype == "<u4" else round(float(v) * 1e9)) if 0 <= v <= (S if dtype == "<u4" else 1) else -1
        for v in values
    ]
    assert (got.stamp_ns, got.offsets_ns.tolist(), got.time_fields) == (T0, expected, ())
    assert contract_timed(cloud(T0, values, "time")).offsets_ns is None


def test_times_that_ran_under_are_strays() -> None:
    """Ouster's: a little before the stamp, written without a sign. Each fifth, so that a stride may find only those."""
    under = np.arange(N) % 5 == 0
    values = np.where(under, 2**32 - 1 - np.arange(N), np.rint(AFTER * 1e9)).astype("<u4")
    raw = cloud(T0, values)
    form = TimeForm("t", "ns", "start")
    assert form_of([raw]) == form
    got = timed(raw, form)
    assert (got.stamp_ns, got.offsets_ns[under].tolist()) == (T0 + int(values[1]), [-1] * under.sum())
    assert (got.stamp_ns + got.offsets_ns[~under]).tolist() == (T0 + values[~under].astype(int)).tolist()
    assert not misfit(raw, form)


def test_a_flag_is_no_time() -> None:
    clouds = [cloud(T0 + k * S, (np.arange(N) % 2).astype("<u4")) for k in range(5)]
    assert isinstance(form_of(clouds), Ambiguous)


def test_a_slow_scanner_is_read_by_one_cloud_where_no_more_come_in_time() -> None:
    slow = [cloud(T0, (AFTER * 9e9).astype("<u4"))]
    assert form_of(slow) is None
    assert form_of(slow, last=True) == TimeForm("t", "ns", "start")
    few = [cloud(T0, np.linspace(0.0, 0.099, 30).astype("<f4"))]
    assert form_of(few) is None, "perhaps the first tenth of a millisecond"
    assert form_of(few, last=True) == TimeForm("t", "s", "start"), "by the contract"
