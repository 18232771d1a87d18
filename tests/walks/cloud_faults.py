"""Faults of clouds, and of the way to the service."""

from dataclasses import replace
from random import Random

import numpy as np
import walks_paths  # noqa: F401 - before what it makes importable
from walk_fault import Fault, Names, a_sensor, name_of, of_clouds, table_of
from walker import Message, S

# Clouds


def times_unclear(random: Random) -> Fault:
    sensor = a_sensor(random)

    def shares(m: Message) -> list[Message]:
        return [replace(m, times={"time": np.linspace(0.0, 1.0, len(m.points)).astype(np.float32)})]

    names = Names(
        log=("stream_lost time_form", f'time_field = "none" in {table_of(sensor)}'), health="time_field",
        doctor=rf"unclear how the times of points in '{name_of(sensor)}' are meant.*from 0\S* to 1",
        advice=rf'{table_of(sensor)}\ntime_field = "none"$',
    )  # fmt: skip
    return Fault(of_clouds(sensor, shares), names, sensor, sensor)


def times_change(random: Random) -> Fault:
    sensor, form = a_sensor(random), random.choice(("end", "absolute", "us"))

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
        log=("sensor_time", f"'{name}' in {unit}"), health=f"'{name}' in {unit}", verdict="ok", lasting=False,
        doctor=rf"points in '{name_of(sensor)}' have times: {name} .* in {unit}",
    )  # fmt: skip
    return Fault(of_clouds(sensor, convert), names, f"{sensor} to {name} in {unit}", sensor)


def unknown_frame(random: Random) -> Fault:
    sensor = a_sensor(random)
    frame = random.choice((f"/{sensor}", "velodyne", "os1 sensor"))
    names = Names(
        log=("stream_lost unknown_sensor", "neither the map's"), health="add .*sensors.* with its translation",
        doctor=f"clouds in frame '{name_of(frame)}' are refused",
        advice="leading slash" if frame.startswith("/") else r"\[sensors\.[^]]*\]\ntranslation",
    )  # fmt: skip
    return Fault(of_clouds(sensor, lambda m: [replace(m, frame=frame)]), names, f"{frame!r}", frame)


def equal_points(random: Random) -> Fault:
    sensor, number = a_sensor(random), random.randrange(1000, 2000)
    at = np.array([random.choice((0.01, -0.02)), 0.0, random.uniform(-0.1, 0.1)], np.float32)

    def add(m: Message) -> list[Message]:
        times = {name: np.concatenate([v, np.full(number, v[-1])]) for name, v in m.times.items()}
        return [replace(m, points=np.concatenate([m.points, np.tile(at, (number, 1))]), times=times)]

    names = Names(
        log=("lost_some duplicate_return", r"\d+ of the [\d,]+ points of a cloud"),
        health=r"rejected as duplicate_return",
        doctor=rf"points of a cloud in '{name_of(sensor)}' are equal",
        advice=r"\(0, 0, 0\) or NaN", verdict="note", lasting=False,
    )  # fmt: skip
    return Fault(of_clouds(sensor, add), names, f"{sensor}, {number}", sensor)


def too_many_tiles(random: Random) -> Fault:
    sensor, reach = a_sensor(random), random.uniform(90.0, 180.0)
    noise = np.random.default_rng(random.randrange(1 << 32))

    def spread(m: Message) -> list[Message]:
        turns, ranges = noise.uniform(0.0, 2.0 * np.pi, 4000), noise.uniform(2.0, reach, 4000)
        far = np.column_stack([ranges * np.cos(turns), ranges * np.sin(turns), np.full(4000, -1.0)])
        return [replace(m, points=far.astype(np.float32), times={})]

    names = Names(
        log=("stream_lost too_many_tiles", rf"points are up to .*map\.max_new_tiles.*max_range in {table_of(sensor)}"),
        health="map.max_new_tiles", doctor=rf"a cloud in '{name_of(sensor)}' reaches .*too_many_tiles",
        advice=rf"{table_of(sensor)}\nmax_range = \d+",
    )  # fmt: skip
    return Fault(of_clouds(sensor, spread), names, f"{sensor} over {reach:.0f} m", sensor)


def millimetres(random: Random) -> Fault:
    sensor = a_sensor(random)
    names = Names(
        log=("stream_lost range", "100 % of the points .*max_range = 100.*metres"), health="max_range.*in metres",
        doctor=rf"points in .*'{name_of(sensor)}' are [\d,]+ m away", advice="metres",
    )  # fmt: skip
    return Fault(of_clouds(sensor, lambda m: [replace(m, points=m.points * np.float32(1000))]), names, sensor, sensor)


def excluded(random: Random) -> Fault:
    sensor, share = a_sensor(random), random.uniform(0.15, 0.3)
    names = Names(
        log=("stream_lost self", rf"check exclude in {table_of(sensor)}"), health="exclude",
        doctor=rf"{name_of(sensor)}.*exclude|rejected as self",
    )  # fmt: skip
    return Fault(of_clouds(sensor, lambda m: [replace(m, points=m.points * np.float32(share))]), names, sensor, sensor)


def losses(random: Random) -> Fault:
    share, chance = random.uniform(0.15, 0.5), Random(random.random())
    names = Names(
        log=("gap", "lost on the way"), health="lost on the way",
        doctor=r"of \d+ (clouds|poses) were lost on the way", advice="BLOCK", lasting=False, of_sensor=False,
    )  # fmt: skip
    return Fault(lambda m: [replace(m, lost=chance.random() < share)], names, f"{100 * share:.0f} %")
