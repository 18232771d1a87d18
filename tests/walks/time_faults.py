"""Faults of clocks and stamps."""

import math
from dataclasses import replace
from random import Random

import walks_paths  # noqa: F401 - before what it makes importable
from walk_fault import Fault, Names, a_sensor, name_of, of_clouds, of_odometry, table_of
from walker import SENSORS, Message

# Clocks of the robot


def clock_back(random: Random) -> Fault:
    step = math.exp(random.uniform(math.log(0.3), math.log(10.0)))
    names = Names(
        log=("clock_reset", "went back"), health="stamps went back", doctor=r"stamps of .* went back by",
        advice="slewing", lasting=False, of_sensor=False,
    )  # fmt: skip
    return Fault(lambda m: [m.later(-step)], names, f"by {step:.2f} s")


def clock_forward(random: Random) -> Fault:
    step = random.uniform(2.0, 10.0)
    names = Names(
        log=("clock_forward", r"leapt \d+\.\d s forward"), health=r"leapt \d+\.\d s forward",
        doctor="leapt ahead by", advice="slewing", lasting=False, of_sensor=False,
    )  # fmt: skip
    return Fault(lambda m: [m.later(step)], names, f"by {step:.2f} s")


def stamps_unset(random: Random) -> Fault:
    what = random.choice(("odometry", *SENSORS))
    unset = lambda m: [replace(m, stamp_ns=0)]  # noqa: E731
    effect = of_odometry(unset) if what == "odometry" else of_clouds(what, unset)
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
    return Fault(of_odometry(freeze), names)


def bursts(random: Random) -> Fault:
    number, together = random.choice((3, 4, 5)), [0, 0]  # messages of the present burst, and its first stamp

    def gather(m: Message) -> list[Message]:
        if together[0] % number == 0:
            together[1] = m.stamp_ns
        stamp = together[1] + together[0] % number * 10**6
        together[0] += 1
        return [replace(m, stamp_ns=stamp)]

    said = r"stamped in bursts: about \d poses 1\.0 ms apart, then none for 0\.\d\d s"
    names = Names(
        log=("remark bursts", said), health=said, doctor=said, advice="when it is measured",
        of_sensor=False,
    )  # fmt: skip
    return Fault(of_odometry(gather), names, f"of {number}")


def cloud_frozen(random: Random) -> Fault:
    sensor, frozen = a_sensor(random), []

    def freeze(m: Message) -> list[Message]:
        frozen.append(m.stamp_ns)
        return [replace(m, stamp_ns=frozen[0])]

    names = Names(
        log=("stream_lost clock_offset", "have one stamp.*stamp each cloud"), health="clouds in a row have one stamp",
        doctor=rf"clouds in '{name_of(sensor)}' have one stamp again and again", advice="stamp each message",
    )  # fmt: skip
    return Fault(of_clouds(sensor, freeze), names, sensor, sensor)


def wild_stamps(random: Random) -> Fault:
    ahead, phase = random.choice((3600.0, 86400.0, 60.0)), random.randrange(8)
    numbers = iter(range(1 << 62))
    said = r"far ahead of the others; [\d.]+ s ahead"
    names = Names(
        log=("lost_some ahead", said), health=said, doctor=r"poses have wild stamps", lasting=False, of_sensor=False
    )
    effect = of_odometry(lambda m: [m.later(ahead if next(numbers) % 8 == phase else 0.0)])
    return Fault(effect, names, f"one in 8 by {ahead:g} s")


def two_sources(random: Random) -> Fault:
    behind, off = random.uniform(0.03, 0.5), random.uniform(0.0, 0.02)

    def double(m: Message) -> list[Message]:
        x, y, z = m.position
        # The second one is late by so much, with an error of its own.
        return [m, replace(m, position=(x - behind, y + off, z)).later(-behind)]

    names = Names(
        log=("remark", "two sources"), health="two sources", doctor="older than the one before",
        advice="second publisher", of_sensor=False,
    )  # fmt: skip
    return Fault(of_odometry(double), names, f"the second one {behind:.2f} s late")


# Clocks of a sensor


def sensor_ahead(random: Random) -> Fault:
    sensor = a_sensor(random)
    offset = rf"time_offset = -3[67]\.\d+ in {table_of(sensor)}"
    names = Names(
        log=("stream_lost no_pose", rf"newest pose is 3[67]\.\d s behind.*{offset}"),
        health=offset,
        doctor=rf"clouds in '{name_of(sensor)}' are stamped 37\.0 s ahead of the odometry.*TAI",
        advice=rf"{table_of(sensor)}\ntime_offset = -37\.0$",
        time_offset=-37.0,
    )
    return Fault(of_clouds(sensor, lambda m: [m.later(37.0)]), names, sensor, sensor)


def sensor_behind(random: Random) -> Fault:
    sensor = a_sensor(random)
    offset = rf"time_offset = 1[12]\.\d+ in {table_of(sensor)}"
    names = Names(
        log=("stream_lost (late|no_pose|clock_offset)", offset), health=offset,
        doctor=rf"clouds in '{name_of(sensor)}' are stamped 1[12]\.\d+ s behind the odometry",
        advice=rf"{table_of(sensor)}\ntime_offset = 1[12]\.\d+$", time_offset=12.0,
    )  # fmt: skip
    return Fault(of_clouds(sensor, lambda m: [m.later(-12.0)]), names, sensor, sensor)


def sensor_moves(random: Random) -> Fault:
    sensor, step = a_sensor(random), random.uniform(0.28, 0.42)
    names = Names(
        log=("remark clock", rf"its clock moved.*ahead of.*{table_of(sensor)}"), health="its clock moved",
        doctor=rf"clouds in '{name_of(sensor)}' came .* sooner .*one clock moved alone|"
               rf"stamps of clouds in '{name_of(sensor)}' leapt ahead",
        verdict="note",
    )  # fmt: skip
    return Fault(of_clouds(sensor, lambda m: [m.later(step)]), names, f"{sensor} by {step:.2f} s", sensor)


def sensor_leaps(random: Random) -> Fault:
    sensor, step = a_sensor(random), random.choice((-1, 1)) * random.uniform(2.0, 5.0)
    offset = rf"time_offset = {'-' if step > 0 else ''}\d\.\d in {table_of(sensor)}"
    names = Names(
        log=("stream_lost (clock_offset|no_pose)", offset), health=offset,
        doctor=rf"clouds in '{name_of(sensor)}' (leapt ahead|went back)", time_offset=-step,
    )  # fmt: skip
    return Fault(of_clouds(sensor, lambda m: [m.later(step)]), names, f"{sensor} by {step:+.2f} s", sensor)
