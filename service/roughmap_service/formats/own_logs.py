"""roughmap's own logs: the clouds, poses and transforms of one robot, as they came.

`roughmap replay` maps a log by its events instead, bit for bit.
"""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from roughmap_schemas import Config, Keys, MessageFault
from roughmap_schemas.kinds import Kind, RobotMessage
from roughmap_schemas.run_metadata import RECORD_NAME, RunMetadata
from roughmap_service.formats.bag_files import fault
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import CloudFileFault, Contents

if TYPE_CHECKING:
    from mcap.reader import SeekingReader
    from mcap.summary import Summary


def is_own_log(reader: "SeekingReader") -> bool:
    """Return whether a file is a log of roughmap."""
    return any(record.name == RECORD_NAME for record in reader.iter_metadata())


def read_own_log(
    path: Path, reader: "SeekingReader", summary: "Summary", options: ReadOptions
) -> Iterator[Contents | RobotMessage]:
    """Return the messages of the log's robot in order. Raises CloudFileFault, also if there are several robots."""
    try:
        record = next(one for one in reader.iter_metadata() if one.name == RECORD_NAME)
        config = Config.from_log(RunMetadata.from_record(record.metadata).configuration)
    except ValueError as error:
        raise CloudFileFault(f"{path}: its settings can't be read: {str(error).splitlines()[0]}") from None
    kinds = _robot(path, summary, Keys(config.map.name, config.keys), options)
    frames = {**config.sensors}
    for robot in config.robots.values():
        frames.update(robot.sensors)
    unknown = [frame for frame in frames if frame not in options.sensors]
    if unknown:
        raise CloudFileFault(
            f"{path}: a log of a robot with [sensors.{unknown[0]}], which is not configured here: give its "
            "service's configuration (-c FILE), or map it as it was by `roughmap replay`"
        )
    yield Contents(config.map.frame_id)
    statistics = summary.statistics
    assert statistics is not None  # noqa: S101 - the caller has looked
    begin_ns, span = statistics.message_start_time, max(statistics.message_end_time - statistics.message_start_time, 1)
    found = reader.iter_messages(list(kinds))
    while True:
        try:
            _, channel, message = next(found)
        except StopIteration:
            options.reached(1.0)
            return
        except Exception as error:  # the library raises almost anything for bad bytes
            raise fault(path, error) from error
        options.reached((message.log_time - begin_ns) / span)
        yield RobotMessage(kinds[channel.topic], message.data, message.log_time)


def _robot(path: Path, summary: "Summary", keys: Keys, options: ReadOptions) -> dict[str, Kind]:
    """Return the topics of the log's only robot, or of the one whose clouds were chosen, and their kinds."""
    topics: dict[str, dict[str, Kind]] = {}
    clouds: Counter[str] = Counter()
    statistics = summary.statistics
    for channel in summary.channels.values():
        for kind, parse in (
            (Kind.POINTS, keys.parse_points),
            (Kind.ODOMETRY, keys.parse_odometry),
            (Kind.TRANSFORM, keys.parse_transform),
        ):
            try:
                robot = parse(channel.topic)
            except MessageFault:
                continue
            topics.setdefault(robot, {})[channel.topic] = kind
            if kind is Kind.POINTS and statistics is not None:
                clouds[channel.topic] += statistics.channel_message_counts.get(channel.id, 0)
    there = {robot: of for robot, of in topics.items() if any(clouds[topic] for topic in of)}
    if options.clouds:
        there = {robot: of for robot, of in there.items() if set(options.clouds) & set(of)}
    if len(there) != 1:
        listed = ", ".join(f"{topic} ({number:,} messages)" for topic, number in sorted(clouds.items())) or "none"
        what = "several robots" if there else "no clouds"
        raise CloudFileFault(f"{path}: {what}: {listed}; choose by --clouds TOPIC")
    return next(iter(there.values()))
