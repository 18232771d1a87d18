"""Rows of the map core: nanoseconds a point of `add_scan` by model, time, order, width and threads."""

from collections.abc import Callable
from functools import partial

from figures import Bench, Mark, Row, missing_row, rounds_row
from reference import NoCompiler, c_core, c_whole, check_equal
from scans import CELL_SIZE, NOISE, SCANS, Drive, moving, recorded, scattered, still, wide

from roughmap import RoughMap

ROUNDS = 12
UNIT = "ns a point"
WHOLE, CORE, WIDE_CORE = "cuboid in C, whole", "cuboid in C, core", "cuboid in C, core, wide"


def build(model: str, drive: Drive, threads: int = 1) -> str:
    """A map of all scans, made and forgotten; its number of tiles."""
    with filled(model, drive, threads) as built:
        return f"{built.tile_count} tiles"


def filled(model: str, drive: Drive, threads: int = 1) -> RoughMap:
    """The map of all scans, everything else by default."""
    built = RoughMap(CELL_SIZE, model, threads=threads)
    for scan in drive.scans:
        built.add_scan(scan, drive.way, NOISE)
    return built


def rows(bench: Bench) -> list[Row]:
    """All of the core's figures but those over tiles held."""
    recording = recorded(bench.folder, 3 if bench.quick else SCANS)
    drives = {
        "still": still(recording),
        "rows": moving(recording, "rows"),
        "columns": moving(recording, "columns"),
        "mixed": scattered(recording),
        "scattered": moving(recording, "scattered"),
        "wide": wide(1 if bench.quick else 4),
    }
    points = {name: drive.points for name, drive in drives.items()}
    runs: dict[str, Callable[[], object]] = {
        f"{model}, {name}": partial(build, model, drives[name])
        for model, names in (("cuboid", drives), ("point", ("still", "rows")), ("ellipsoid", ("still", "rows")))
        for name in names
    }
    runs["two threads"] = partial(build, "cuboid", drives["still"], 2)
    sizes = {name: points[name.split(", ")[-1]] for name in runs if ", " in name}
    sizes["two threads"] = points["still"]
    runs |= _references(bench, drives)
    sizes |= {WHOLE: points["still"], CORE: points["still"], WIDE_CORE: points["wide"]}
    _same_digest(drives["still"])
    bench.say(f"core: {points['still']:,} points in {len(recording.points)} scans")
    taken = bench.interleaved(ROUNDS, runs, both=["two threads"])
    ns = {name: [t / sizes[name] * 1e9 for t in each] for name, each in taken.items()}
    return [*_by_model(ns), *_against_c(ns), *_by_order(ns), _two_threads(taken)]


def _references(bench: Bench, drives: dict[str, Drive]) -> dict[str, Callable[[], object]]:
    """The C references, after each has shown that it makes the map's cells; none without gcc."""
    try:
        whole, core = c_whole(bench.folder, drives["still"]), c_core(bench.folder, drives["still"])
        wide_core = c_core(bench.folder, drives["wide"])
    except NoCompiler:
        return {}
    with filled("cuboid", drives["still"]) as built:
        check_equal(whole(keep=True) or {}, built)
        check_equal(core(), built)
    with filled("cuboid", drives["wide"]) as built:
        check_equal(wide_core(), built)
    return {WHOLE: whole, CORE: core, WIDE_CORE: wide_core}


def _same_digest(drive: Drive) -> None:
    with filled("cuboid", drive) as one, filled("cuboid", drive, threads=2) as two:
        assert one.digest() == two.digest(), "two threads made other bytes than one"


def _by_model(ns: dict[str, list[float]]) -> list[Row]:
    beside = {"reference": WHOLE, "beside": ns[WHOLE]} if WHOLE in ns else {}
    cuboid = ns["cuboid, still"]
    return [
        rounds_row("core.cuboid", "add_scan, cuboid", UNIT, cuboid, mark=Mark(45.0), **beside),
        rounds_row(
            "core.deskew", "add_scan, cuboid, per-point times, 10 poses a sweep", UNIT, ns["cuboid, rows"],
            mark=Mark(1.3, "ratio"), reference="one pose a scan", beside=cuboid,
        ),
        rounds_row("core.point", "add_scan, point", UNIT, ns["point, still"], mark=Mark(20.0), **beside),
        rounds_row("core.ellipsoid", "add_scan, ellipsoid", UNIT, ns["ellipsoid, still"], mark=Mark(150.0), **beside),
        rounds_row(
            "core.point.deskew", "add_scan, point, per-point times", UNIT, ns["point, rows"],
            reference="one pose a scan", beside=ns["point, still"],
        ),
        rounds_row(
            "core.ellipsoid.deskew", "add_scan, ellipsoid, per-point times", UNIT, ns["ellipsoid, rows"],
            reference="one pose a scan", beside=ns["ellipsoid, still"],
        ),
    ]  # fmt: skip


def _against_c(ns: dict[str, list[float]]) -> list[Row]:
    """Rates: the reference's time over ours, at least 0.9."""
    mark = Mark(0.9, "ratio", least=True)
    if WHOLE not in ns:
        return [missing_row("core.c", "points a second against C", "M/s", mark, "no gcc here")]
    ours, whole, core = ([1e3 / t for t in each] for each in (ns["cuboid, still"], ns[WHOLE], ns[CORE]))
    return [
        rounds_row(
            "core.c", "points a second against C", "M/s", ours, mark=mark, reference=f"{WHOLE}, -O3", beside=whole,
            note="equal cells, asserted",
        ),
        rounds_row(
            "core.c.floor", "... against a floor: no placing, no tests, no tiles", "M/s", ours,
            reference=f"{CORE}, -O3", beside=core, note="equal cells, asserted",
        ),
    ]  # fmt: skip


def _by_order(ns: dict[str, list[float]]) -> list[Row]:
    figures = {
        "columns": "... column after column, per-point times",
        "mixed": "... points in no order, one pose a scan",
        "scattered": "... points in no order, per-point times",
    }
    found = [
        rounds_row(
            f"core.order.{name}", figure, UNIT, ns[f"cuboid, {name}"],
            reference="ring after ring", beside=ns["cuboid, still" if name == "mixed" else "cuboid, rows"],
        )
        for name, figure in figures.items()
    ]  # fmt: skip
    beside = {"reference": CORE, "beside": ns[WIDE_CORE]} if WIDE_CORE in ns else {}
    return [
        *found,
        rounds_row("core.wide", "... footprints of points 30 to 60 m away", UNIT, ns["cuboid, wide"], **beside),
    ]


def _two_threads(taken: dict[str, list[float]]) -> Row:
    one, two = ([1.0 / t for t in taken[name]] for name in ("cuboid, still", "two threads"))
    return rounds_row(
        "core.threads", "scans' drive, two threads against one, same bytes", "1/s", two,
        mark=Mark(1.7, "ratio", least=True), reference="one thread", beside=one,
    )  # fmt: skip
