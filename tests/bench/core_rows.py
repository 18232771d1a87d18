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
KNOWN = "cuboid, known ground"


def build(model: str, drive: Drive, threads: int = 1) -> str:
    """A map of all scans, made and forgotten; its number of tiles."""
    with filled(model, drive, threads) as built:
        return f"{built.tile_count} tiles"


def filled(model: str, drive: Drive, threads: int = 1, **settings: str) -> RoughMap:
    """The map of all scans; what is not given stays at its default, which older versions know too."""
    built = RoughMap(CELL_SIZE, model, threads=threads, **settings)
    add_all(built, drive)
    return built


def add_all(built: RoughMap, drive: Drive) -> None:
    """All scans into a map."""
    for scan in drive.scans:
        built.add_scan(scan, drive.way, NOISE)


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
    sizes = {name: points[name.split(", ")[-1]] for name in runs}
    runs[KNOWN] = partial(add_all, filled("cuboid", drives["still"]), drives["still"])
    runs |= _references(bench, drives)
    sizes |= dict.fromkeys((KNOWN, WHOLE, CORE), points["still"]) | {WIDE_CORE: points["wide"]}
    bench.say(f"core: {points['still']:,} points in {len(recording.points)} scans")
    taken = bench.interleaved(ROUNDS, runs)
    ns = {name: [t / sizes[name] * 1e9 for t in each] for name, each in taken.items()}
    return [*_by_model(ns), *_against_c(ns), *_by_order(ns)]


def _references(bench: Bench, drives: dict[str, Drive]) -> dict[str, Callable[[], object]]:
    """The C references, after each has shown that it makes the map's cells; none without gcc."""
    try:
        whole, core = c_whole(bench.folder, drives["still"]), c_core(bench.folder, drives["still"])
        wide_core = c_core(bench.folder, drives["wide"])
    except NoCompiler:
        return {}
    with filled("cuboid", drives["still"], surface="all") as built:
        check_equal(whole(keep=True) or {}, built)
        check_equal(core(), built)
    with filled("cuboid", drives["wide"], surface="all") as built:
        check_equal(wide_core(), built)
    return {WHOLE: whole, CORE: core, WIDE_CORE: wide_core}


def _by_model(ns: dict[str, list[float]]) -> list[Row]:
    beside = {"reference": WHOLE, "beside": ns[WHOLE]} if WHOLE in ns else {}
    cuboid = ns["cuboid, still"]
    return [
        rounds_row("core.cuboid", "add_scan, cuboid", UNIT, cuboid, mark=Mark(45.0), **beside),
        rounds_row(
            "core.known", "... on ground that is known, whose memory is there", UNIT, ns[KNOWN],
            reference="new ground", beside=cuboid,
        ),
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
        return [missing_row("core.c", "add_scan, cuboid, against C", "M points/s", mark, "no gcc here")]
    ours, whole, core = ([1e3 / t for t in each] for each in (ns["cuboid, still"], ns[WHOLE], ns[CORE]))
    return [
        rounds_row(
            "core.c", "add_scan, cuboid, against C", "M points/s", ours, mark=mark, reference=f"{WHOLE}, -O3",
            beside=whole,
            note="equal cells, asserted",
        ),
        rounds_row(
            "core.c.floor", "... against a floor in C: no placing, no tests, no tiles", "M points/s", ours,
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
