"""The faults of a walk, drawn by chance, and who must name each with which words."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from random import Random
from typing import Any, Literal

import numpy as np
import walks_paths  # noqa: F401 - before what it makes importable
from walker import PRECISE, SENSORS, Effect, Message, S

from roughmap_schemas.kinds import Kind

MAP_SETTINGS: dict[str, Any] = {"max_new_tiles": 256}
"""Few tiles, so that a cloud of some thousand points can need more."""

Begins = Literal["before", "meanwhile", "first"]
"""When a fault begins: just before the doctor listens; while it does (a single event); with the robot's life."""


@dataclass(frozen=True)
class Names:
    """Who names a fault: regular expressions. An empty one: by its nature the fault costs nothing worth it there.

    ``log``: "event" or "event reason" of a log line, then words of its text. ``health``: the sentence in `problems`.
    ``doctor``: the text of a finding; ``advice``: its remedy and settings; by ``verdict``. ``count``: what the status
    counts instead of a log line, such as "poses ahead". ``of_sensor``: the subject is the sensor, else the robot.
    ``time_offset``: the right one, wherever one is advised.
    """

    log: tuple[str, str] | None = None
    health: str = ""
    doctor: str = ""
    advice: str = ""
    verdict: Literal["ok", "note", "wrong"] = "wrong"
    count: str = ""
    of_sensor: bool = True
    time_offset: float = 0.0


@dataclass(frozen=True)
class Fault:
    """A drawn fault. ``told``: its parameters, for the table. ``sensor``: the frame that it concerns, or none."""

    effect: Effect
    names: Names
    told: str = ""
    sensor: str = ""


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault: how it is drawn, when it begins, the robot's settings, what the robot's scanners must be like.

    ``costs``: "sensors" if they may be problems too. ``ends``: whether the problem ends soon after the fault.
    """

    title: str
    draw: Callable[[Random], Fault]
    begins: Begins = "before"
    settings: Mapping[str, Any] = field(default_factory=dict)
    timed: bool | None = None
    costs: str = ""
    ends: bool = True


def _odometry(change: Callable[[Message], list[Message]]) -> Effect:
    return lambda m: change(m) if m.kind is Kind.ODOMETRY else [m]


def _clouds(sensor: str, change: Callable[[Message], list[Message]]) -> Effect:
    return lambda m: change(m) if m.sensor == sensor else [m]


def _sensor(random: Random) -> str:
    return random.choice(SENSORS)


def _table(sensor: str) -> str:
    """The head of the sensor's table in a remedy, as a regular expression."""
    return r'\[[^]]*sensors\."os\.lidar"\]' if sensor == "os.lidar" else r"\[[^]]*sensors\.rear\]"


def _frame(sensor: str) -> str:
    return sensor.replace(".", r"\.")


# Clocks of the robot


def clock_back(random: Random) -> Fault:
    step = math.exp(random.uniform(math.log(0.3), math.log(10.0)))
    names = Names(
        log=("clock_reset", "went back"), doctor=r"stamps of .* went back by", advice="slewing", of_sensor=False
    )
    return Fault(lambda m: [m.later(-step)], names, f"by {step:.2f} s")


def clock_forward(random: Random) -> Fault:
    step = random.uniform(2.0, 10.0)
    names = Names(doctor="leapt ahead by", advice="slewing", of_sensor=False)
    return Fault(lambda m: [m.later(step)], names, f"by {step:.2f} s")


def stamps_unset(random: Random) -> Fault:
    what = random.choice(("odometry", *SENSORS))
    unset = lambda m: [replace(m, stamp_ns=0)]  # noqa: E731
    effect = _odometry(unset) if what == "odometry" else _clouds(what, unset)
    sensor = "" if what == "odometry" else what
    names = Names(
        log=("stream_lost unset_stamp", "stamp is 0"), health="stamp is 0", doctor=r"no stamp \(0\)",
        advice="header.stamp", of_sensor=bool(sensor),
    )  # fmt: skip
    return Fault(effect, names, what, sensor)


def odometry_frozen(random: Random) -> Fault:
    frozen: list[int] = []

    def freeze(m: Message) -> list[Message]:
        frozen.append(m.stamp_ns)
        return [replace(m, stamp_ns=frozen[0])]

    names = Names(
        log=("stream_lost frozen", "all have one stamp"), health="all have one stamp",
        doctor="poses have one stamp again and again", advice="stamp each message", of_sensor=False,
    )  # fmt: skip
    return Fault(_odometry(freeze), names)


def cloud_frozen(random: Random) -> Fault:
    sensor, frozen = _sensor(random), []

    def freeze(m: Message) -> list[Message]:
        frozen.append(m.stamp_ns)
        return [replace(m, stamp_ns=frozen[0])]

    names = Names(
        log=("stream_lost clock_offset", "have one stamp.*stamp each cloud"), health="clouds in a row have one stamp",
        doctor=rf"clouds in '{_frame(sensor)}' have one stamp again and again", advice="stamp each message",
    )  # fmt: skip
    return Fault(_clouds(sensor, freeze), names, sensor, sensor)


def wild_stamps(random: Random) -> Fault:
    ahead, phase = random.choice((3600.0, 86400.0, 60.0)), random.randrange(8)
    numbers = iter(range(1 << 62))
    names = Names(count="poses ahead", doctor=r"poses have wild stamps", of_sensor=False)
    effect = _odometry(lambda m: [m.later(ahead if next(numbers) % 8 == phase else 0.0)])
    return Fault(effect, names, f"one in 8 by {ahead:g} s")


def two_sources(random: Random) -> Fault:
    behind, off = random.uniform(0.15, 0.5), random.uniform(0.0, 0.02)

    def double(m: Message) -> list[Message]:
        x, y, z = m.position
        # The second one is late by so much, with an error of its own.
        return [m, replace(m, position=(x - behind, y + off, z)).later(-behind)]

    names = Names(
        log=("two_sources", "two sources"), health="two sources", doctor="older than the one before",
        advice="second publisher", of_sensor=False,
    )  # fmt: skip
    return Fault(_odometry(double), names, f"the second one {behind:.2f} s late")


# Clocks of a sensor


def sensor_ahead(random: Random) -> Fault:
    sensor = _sensor(random)
    offset = rf"time_offset = -3[67]\.\d+ in {_table(sensor)}"
    names = Names(
        log=("stream_lost no_pose", rf"newest pose is 3[67]\.\d s behind.*{offset}"),
        health=offset,
        doctor=rf"clouds in '{_frame(sensor)}' are stamped 37\.0 s ahead of the odometry.*TAI",
        advice=rf"{_table(sensor)}\ntime_offset = -37\.0$",
        time_offset=-37.0,
    )
    return Fault(_clouds(sensor, lambda m: [m.later(37.0)]), names, sensor, sensor)


def sensor_behind(random: Random) -> Fault:
    sensor = _sensor(random)
    offset = rf"time_offset = 1[12]\.\d+ in {_table(sensor)}"
    names = Names(
        log=("stream_lost (late|no_pose|clock_offset)", offset), health=offset,
        doctor=rf"clouds in '{_frame(sensor)}' are stamped 1[12]\.\d+ s behind the odometry",
        advice=rf"{_table(sensor)}\ntime_offset = 1[12]\.\d+$", time_offset=12.0,
    )  # fmt: skip
    return Fault(_clouds(sensor, lambda m: [m.later(-12.0)]), names, sensor, sensor)


def sensor_moves(random: Random) -> Fault:
    sensor, step = _sensor(random), random.uniform(0.28, 0.42)
    names = Names(
        log=("remark clock", rf"its clock moved.*ahead of.*{_table(sensor)}"), health="its clock moved",
        doctor=rf"clouds in '{_frame(sensor)}' came .* sooner .*one clock moved alone|"
               rf"stamps of clouds in '{_frame(sensor)}' leapt ahead",
        verdict="note",
    )  # fmt: skip
    return Fault(_clouds(sensor, lambda m: [m.later(step)]), names, f"{sensor} by {step:.2f} s", sensor)


def sensor_leaps(random: Random) -> Fault:
    sensor, step = _sensor(random), random.choice((-1, 1)) * random.uniform(2.0, 5.0)
    offset = rf"time_offset = {'-' if step > 0 else ''}\d\.\d in {_table(sensor)}"
    names = Names(
        log=("stream_lost (clock_offset|no_pose)", offset), health=offset,
        doctor=rf"clouds in '{_frame(sensor)}' (leapt ahead|went back)", time_offset=-step,
    )  # fmt: skip
    return Fault(_clouds(sensor, lambda m: [m.later(step)]), names, f"{sensor} by {step:+.2f} s", sensor)


# Poses


def leap(random: Random) -> Fault:
    to = random.uniform(0.6, 5.0) * random.choice((-1, 1))
    names = Names(log=("leap", r"leapt \d+\.\d\d m"), doctor="odometry leapt by", advice="odom", of_sensor=False)

    def move(m: Message) -> list[Message]:
        x, y, z = m.position
        return [replace(m, position=(x, y + to, z))]

    return Fault(_odometry(move), names, f"by {abs(to):.2f} m")


def leaps(random: Random) -> Fault:
    to, numbers = random.uniform(0.6, 3.0), iter(range(1 << 62))
    names = Names(
        log=("stream_lost pose_jump", r"it moved \d+\.\d\d m in"), health=r"it moved \d+\.\d\d m in",
        doctor=r"odometry leapt \d+ times", advice="odom",
    )  # fmt: skip

    def move(m: Message) -> list[Message]:
        x, y, z = m.position
        return [replace(m, position=(x, y + to * (next(numbers) // 2 % 2), z))]

    return Fault(_odometry(move), names, f"by {to:.2f} m again and again")


def restarts_at_origin(random: Random) -> Fault:
    first: list[tuple[float, ...]] = []

    def restart(m: Message) -> list[Message]:
        first.append(m.position)
        x, y, z = (p - f for p, f in zip(m.position, first[0], strict=True))
        return [replace(m, position=(x, y, z))]

    names = Names(log=("leap", r"leapt \d\d\.\d\d m"), doctor="odometry leapt by", advice="odom", of_sensor=False)
    return Fault(_odometry(restart), names)


def no_odometry(random: Random) -> Fault:
    names = Names(
        log=("stream_lost no_pose", r"its last odometry came \d+ s ago|newest pose is"),
        health=r"its last odometry came \d+ s ago|the newest pose is [\d.]+ s behind",
        doctor="no odometry: its clouds can't be placed", advice="publish the localisation's poses",
    )  # fmt: skip
    return Fault(_odometry(lambda m: []), names)


def never_odometry(random: Random) -> Fault:
    names = Names(
        log=("stream_lost no_pose", "no odometry has come from the robot"), health="no odometry has come",
        doctor="no odometry: its clouds can't be placed", advice="publish the localisation's poses",
    )  # fmt: skip
    return Fault(_odometry(lambda m: []), names)


def odometry_slow(random: Random) -> Fault:
    period, last = random.uniform(0.7, 1.4), [-math.inf]

    def thin(m: Message) -> list[Message]:
        if m.made < last[0] + period:
            return []
        last[0] = m.made
        return [m]

    names = Names(
        log=("stream_lost (pose_gap|no_pose)", rf"{period - 0.05:.1f}\d* s apart.*|poses are .* apart.*publish poses"),
        health="poses are .* apart.*publish poses more often",
        doctor=r"poses were up to \d\.\d\d s apart", advice="more often|input.max_pose_gap",
    )  # fmt: skip
    return Fault(_odometry(thin), names, f"every {period:.2f} s")


def frame_slash(random: Random) -> Fault:
    names = Names(
        log=("stream_lost pose_frame", 'their frame is "/map".*write their frame as "map"'),
        health='write their frame as "map"', doctor=r"odometry in frame '/map' is rejected \(pose_frame\)",
        advice="slash", of_sensor=False,
    )  # fmt: skip
    return Fault(_odometry(lambda m: [replace(m, frame="/map")]), names)


def no_transform(random: Random) -> Fault:
    frame = random.choice(("odom", "world", "camera_init"))
    names = Names(
        log=("stream_lost pose_frame", f'their frame is "{frame}".*publish a transform'), health="publish a transform",
        doctor=rf"odometry in frame '{frame}' is rejected \(pose_frame\)", advice="publish that transform",
        verdict="note", of_sensor=False,
    )  # fmt: skip
    return Fault(_odometry(lambda m: [replace(m, frame=frame)]), names, f"from {frame!r}")


# Covariances


def _covariance(matrix: np.ndarray) -> Effect:
    return _odometry(lambda m: [replace(m, covariance=matrix)])


def covariance_wide(random: Random) -> Fault:
    sigma = random.uniform(0.28, 1.5)
    matrix = np.diag([sigma**2, sigma**2, 1e-4, 1e-5, 1e-5, 1e-5])
    said = rf"2 sigma = {2 * sigma:.2f} m, map\.max_horizontal_radius = 0\.5"
    names = Names(
        log=("stream_lost uncertain", said), health=rf'{said}.*\[robots\.covariance_wide\] pose_covariance = "cap"',
        doctor=rf"rejected as uncertain: .*2 sigma = {2 * sigma:.2f} m", advice='pose_covariance = "cap"',
    )  # fmt: skip
    return Fault(_covariance(matrix), names, f"sigma {sigma:.2f} m")


def covariance_high(random: Random) -> Fault:
    sigma = random.uniform(0.55, 5.0)
    matrix = np.diag([1e-4, 1e-4, sigma**2, 1e-5, 1e-5, 1e-5])
    said = rf"sigma z = {sigma:.2f} m, map\.max_vertical_sigma = 0\.5"
    names = Names(
        log=("stream_lost uncertain", said), health=rf'{said}.*\[robots\.covariance_high\] pose_covariance = "cap"',
        doctor=rf"rejected as uncertain: .*height error.* = {sigma:.2f} m", advice='pose_covariance = "cap"',
    )  # fmt: skip
    return Fault(_covariance(matrix), names, f"sigma z {sigma:.2f} m")


def covariance_not_psd(random: Random) -> Fault:
    matrix = np.diag([3e-3, 1e-4, 1e-4, 1e-6, 1e-6, 1e-4])
    if random.random() < 0.5:
        matrix[0, 1] = matrix[1, 0] = random.uniform(1.2, 3.0) * math.sqrt(matrix[0, 0] * matrix[1, 1])
    else:  # each pair alone is possible
        c = random.uniform(0.75, 0.95)
        for i, j, sign in ((0, 1, 1), (1, 2, 1), (0, 2, -1)):
            matrix[i, j] = matrix[j, i] = sign * c * math.sqrt(matrix[i, i] * matrix[j, j])
    wrong = "positive semidefinite|larger than its variances allow"
    names = Names(
        log=("stream_lost bad_covariance", wrong), health=wrong, doctor=f"invalid covariance: .*({wrong})",
        advice="positive semidefinite", of_sensor=False,
    )  # fmt: skip
    return Fault(_covariance(matrix), names)


def covariance_unknown(random: Random) -> Fault:
    if random.random() < 0.5:
        told, matrix = "1e6", np.diag([1e-3, 1e-3, 1e6, 1e6, 1e6, 1e-3])
    else:
        told, matrix = "-1", np.zeros((6, 6))
        matrix[0, 0] = -1.0
    names = Names(
        log=("covariance_unknown", "input.pose_sigma stands in"), doctor="have no estimate of", advice="pose_sigma",
        of_sensor=False,
    )  # fmt: skip
    return Fault(_covariance(matrix), names, told)


# Clouds


def times_unclear(random: Random) -> Fault:
    sensor = _sensor(random)

    def shares(m: Message) -> list[Message]:
        return [replace(m, times={"time": np.linspace(0.0, 1.0, len(m.points)).astype(np.float32)})]

    names = Names(
        log=("stream_lost time_form", f'time_field = "none" in {_table(sensor)}'), health="time_field",
        doctor=rf"unclear how the times of points in '{_frame(sensor)}' are meant.*from 0\S* to 1",
        advice=rf'{_table(sensor)}\ntime_field = "none"$',
    )  # fmt: skip
    return Fault(_clouds(sensor, shares), names, sensor, sensor)


def times_change(random: Random) -> Fault:
    sensor, form = _sensor(random), random.choice(("end", "absolute", "us"))

    def convert(m: Message) -> list[Message]:
        offsets = m.times["t"].astype(np.float64)
        if form == "end":
            late = m.later(offsets[-1] / S)
            return [replace(late, times={"time": ((offsets - offsets[-1]) / S).astype(np.float32)})]
        if form == "absolute":
            return [replace(m, times={"timestamp": (m.stamp_ns + offsets) / S})]
        return [replace(m, times={"offset_time": (offsets / 1e3).astype(np.uint32)})]

    name, unit = {"end": ("time", "s"), "absolute": ("timestamp", "s"), "us": ("offset_time", "us")}[form]
    names = Names(
        log=("sensor_time", f"'{name}' in {unit}"), verdict="ok",
        doctor=rf"points in '{_frame(sensor)}' have times: {name} .* in {unit}",
    )  # fmt: skip
    return Fault(_clouds(sensor, convert), names, f"{sensor} to {name} in {unit}", sensor)


def unknown_frame(random: Random) -> Fault:
    sensor = _sensor(random)
    frame = random.choice((f"/{sensor}", "velodyne", "os1 sensor"))
    names = Names(
        log=("stream_lost unknown_sensor", "neither the map's"), health="add .*sensors.* with its translation",
        doctor=f"clouds in frame '{_frame(frame)}' are refused",
        advice="leading slash" if frame.startswith("/") else r"\[sensors\.[^]]*\]\ntranslation",
    )  # fmt: skip
    return Fault(_clouds(sensor, lambda m: [replace(m, frame=frame)]), names, f"{frame!r}", frame)


def equal_points(random: Random) -> Fault:
    sensor, number = _sensor(random), random.randrange(1000, 2000)
    at = np.array([random.choice((0.01, -0.02)), 0.0, random.uniform(-0.1, 0.1)], np.float32)

    def add(m: Message) -> list[Message]:
        times = {name: np.concatenate([v, np.full(number, v[-1])]) for name, v in m.times.items()}
        return [replace(m, points=np.concatenate([m.points, np.tile(at, (number, 1))]), times=times)]

    names = Names(
        count="points duplicate_return", doctor=rf"points of a cloud in '{_frame(sensor)}' are equal",
        advice=r"\(0, 0, 0\) or NaN", verdict="note",
    )  # fmt: skip
    return Fault(_clouds(sensor, add), names, f"{sensor}, {number}", sensor)


def too_many_tiles(random: Random) -> Fault:
    sensor, reach = _sensor(random), random.uniform(90.0, 180.0)
    noise = np.random.default_rng(random.randrange(1 << 32))

    def spread(m: Message) -> list[Message]:
        far = np.column_stack([noise.uniform(-reach, reach, (4000, 2)), np.full(4000, -1.0)])
        return [replace(m, points=far.astype(np.float32), times={}, covariance=PRECISE)]

    names = Names(
        log=("stream_lost too_many_tiles", rf"points are up to .*map\.max_new_tiles.*max_range in {_table(sensor)}"),
        health="map.max_new_tiles", doctor=rf"a cloud in '{_frame(sensor)}' reaches .*too_many_tiles",
        advice=rf"{_table(sensor)}\nmax_range = \d+",
    )  # fmt: skip
    return Fault(_clouds(sensor, spread), names, f"{sensor} over {reach:.0f} m", sensor)


def millimetres(random: Random) -> Fault:
    sensor = _sensor(random)
    names = Names(
        log=("stream_lost range", "100 % of the points .*max_range = 100.*metres"), health="max_range.*in metres",
        doctor=rf"points in .*'{_frame(sensor)}' are [\d,]+ m away", advice="metres",
    )  # fmt: skip
    return Fault(_clouds(sensor, lambda m: [replace(m, points=m.points * np.float32(1000))]), names, sensor, sensor)


def excluded(random: Random) -> Fault:
    sensor, share = _sensor(random), random.uniform(0.15, 0.3)
    names = Names(
        log=("stream_lost self", rf"check exclude in {_table(sensor)}"), health="exclude",
        doctor=rf"{_frame(sensor)}.*exclude|rejected as self",
    )  # fmt: skip
    return Fault(_clouds(sensor, lambda m: [replace(m, points=m.points * np.float32(share))]), names, sensor, sensor)


def losses(random: Random) -> Fault:
    share, chance = random.uniform(0.15, 0.5), Random(random.random())
    names = Names(
        log=("gap", "miss|lost|number"), doctor=r"of \d+ (clouds|poses) were lost on the way", advice="BLOCK",
        of_sensor=False,
    )  # fmt: skip
    return Fault(lambda m: [replace(m, lost=chance.random() < share)], names, f"{100 * share:.0f} %")


def none(random: Random) -> Fault:
    return Fault(lambda m: [m], Names())


FAULTS: dict[str, FaultKind] = {
    "clock_back": FaultKind("a robot's clock steps back", clock_back, "meanwhile", costs="sensors"),
    "clock_forward": FaultKind("a robot's clock steps forward", clock_forward, "meanwhile", costs="sensors"),
    "stamps_unset": FaultKind("stamps are not set", stamps_unset, costs="sensors"),
    "odometry_frozen": FaultKind("odometry has one stamp", odometry_frozen, costs="sensors"),
    "cloud_frozen": FaultKind("a sensor's clouds have one stamp", cloud_frozen),
    "wild_stamps": FaultKind("wild stamps of poses", wild_stamps),
    "two_sources": FaultKind("two sources of odometry out of step", two_sources),
    "sensor_ahead": FaultKind("a sensor's clock 37 s ahead", sensor_ahead, "first"),
    "sensor_behind": FaultKind("a sensor's clock 12 s behind", sensor_behind, "first"),
    "sensor_moves": FaultKind("a sensor's clock moves a little alone", sensor_moves, "meanwhile"),
    "sensor_leaps": FaultKind("a sensor's clock leaps alone", sensor_leaps, "meanwhile"),
    "leap": FaultKind("a localisation leaps once", leap, "meanwhile"),
    "leaps": FaultKind("a localisation leaps again and again", leaps, timed=True, costs="sensors"),
    "restart": FaultKind("a localisation restarts at the origin", restarts_at_origin, "meanwhile"),
    "no_odometry": FaultKind("odometry ends", no_odometry, costs="sensors"),
    "never_odometry": FaultKind("odometry never comes", never_odometry, "first", costs="sensors"),
    "odometry_slow": FaultKind("odometry is too slow", odometry_slow, costs="sensors"),
    "frame_slash": FaultKind("odometry in /map", frame_slash, costs="sensors"),
    "no_transform": FaultKind("a transform is missing", no_transform, costs="sensors"),
    "covariance_wide": FaultKind("covariance too large along x and y", covariance_wide, costs="sensors"),
    "covariance_high": FaultKind("covariance too large along z", covariance_high, costs="sensors"),
    "covariance_not_psd": FaultKind("covariance is not positive semidefinite", covariance_not_psd, costs="sensors"),
    "covariance_unknown": FaultKind("covariance is not estimated", covariance_unknown),
    "times_unclear": FaultKind("points' times from 0 to 1", times_unclear),
    "times_change": FaultKind("points' times take another form", times_change, timed=True),
    "unknown_frame": FaultKind("a sensor's frame is not configured", unknown_frame, ends=False),
    "equal_points": FaultKind("a thousand equal points", equal_points),
    "too_many_tiles": FaultKind("cells too small for the range", too_many_tiles),
    "millimetres": FaultKind(
        "points in millimetres, beyond max_range", millimetres,
        settings={"sensors": {frame: {"max_range": 100.0} for frame in SENSORS}},
    ),
    "excluded": FaultKind(
        "all points within exclude", excluded,
        settings={"sensors": {frame: {"exclude": [[-2.0, -2.0, -1.0, 2.0, 2.0, 3.0]]} for frame in SENSORS}},
    ),
    "losses": FaultKind("messages are lost on the way", losses),
    "none": FaultKind("nothing is wrong", none),
}  # fmt: skip
"""By name, which is the robot's too."""
