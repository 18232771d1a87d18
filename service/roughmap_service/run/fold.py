"""From the records of a log to the state of its run: what replay and recovery share with the live service."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from roughmap_schemas import (
    Cloud,
    ContractError,
    Event,
    IntegrationEvent,
    Odometry,
    Transform,
    decode_cloud,
    decode_odometry,
    decode_transform,
)
from roughmap_schemas.kinds import Kind
from roughmap_service.journal.records import FileStart, InputRecord, LogItem
from roughmap_service.run.apply import RunError, RunState
from roughmap_service.run.settings import Settings

Content = Cloud | Odometry | Transform


def decode(kind: Kind, payload: bytes, settings: Settings) -> Content:
    """Bytes to a cloud, odometry or transform. MessageFault for what is none, or is too large."""
    inputs = settings.config.input
    if kind is Kind.POINTS:
        return decode_cloud(
            payload, max_message=inputs.max_message, max_points=inputs.max_points, map_frame=settings.frame_id
        )
    if kind is Kind.ODOMETRY:
        return decode_odometry(payload, max_message=inputs.max_message)
    return decode_transform(payload, max_message=inputs.max_message)


@dataclass(frozen=True, slots=True)
class Step:
    """One item of the log that was taken up; for an event, how it came out this time."""

    item: LogItem
    content: Content | None = None
    outcome: Event | None = None


def fold(state: RunState, items: Iterable[LogItem], *, taken: int = 0, low_water: int = 1) -> Iterator[Step]:
    """Take up the log item by item into ``state``, with the settings that each file names.

    The state already holds the run up to record ``taken`` (a store's cut): of what lies before it, only clouds from
    input ``low_water`` on that were undecided then are taken up. RunError where the log contradicts itself.
    """
    for item in items:
        if isinstance(item, FileStart):
            state.use(Settings(item.config))
            if item.metadata.first_record > taken:
                state.epoch = item.metadata.epoch
            yield Step(item)
        elif isinstance(item, InputRecord):
            before = item.record <= taken
            if before and (item.kind is not Kind.POINTS or item.number < low_water):
                continue
            try:
                content = decode(item.kind, item.payload, state.settings)
            except ContractError as error:
                raise RunError(f"input {item.number} can't be read: {error}") from None
            if isinstance(content, Cloud):
                state.take_cloud(item.number, content)
            elif isinstance(content, Odometry):
                state.take_odometry(item.number, item.robot, content)
            else:
                state.take_transform(item.number, item.robot, content)
            if not before:
                state.input, state.record = item.number, item.record
            yield Step(item, content)
        elif item.record <= taken:
            if isinstance(item.event, IntegrationEvent):
                state.clouds.pop(item.event.input, None)
        else:
            state.record = item.record
            yield Step(item, outcome=state.apply(item.event))
