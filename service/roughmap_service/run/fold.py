"""From the records of a log to the state of its run, the same in a replay and after a restart."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from roughmap_schemas import Cloud, ContractError, Event, IntegrationEvent
from roughmap_schemas.kinds import Kind
from roughmap_service.journal.records import FileStart, InputRecord, LogItem
from roughmap_service.run.decoding import Content, decode
from roughmap_service.run.duplicates import Duplicates
from roughmap_service.run.run import Run, RunError
from roughmap_service.run.settings import Settings


@dataclass(frozen=True, slots=True)
class Step:
    """One item of the log that was applied; for an event, what it resulted in this time."""

    item: LogItem
    outcome: Event | None = None


def fold(run: Run, items: Iterable[LogItem], *, taken: int = 0, low_water: int = 1) -> Iterator[Step]:
    """Apply the log to ``run`` item by item, under the settings that each file names.

    ``run`` already holds everything up to record ``taken`` (a store's cut). Of the items before it, only
    clouds from input ``low_water`` on that were undecided then are applied. RunError if the log contradicts itself.
    """
    for item in items:
        if isinstance(item, FileStart):
            run.use(Settings.of_log(item.config, item.metadata.configuration, item.metadata.rules))
            if item.metadata.first_record > taken:
                run.epoch = item.metadata.epoch
            yield Step(item)
        elif isinstance(item, InputRecord):
            if item.record <= taken:
                if item.kind is Kind.POINTS and item.number >= low_water:
                    cloud = _decode(item, run.settings)
                    assert isinstance(cloud, Cloud)  # noqa: S101 - its kind says so
                    run.keep_again(item.number, item.robot, cloud)
                continue
            content = _decode(item, run.settings)
            run.input, run.record = item.number - 1, item.record - 1
            run.take(item.robot, content, Duplicates.identity(item.robot, item.kind, item.payload), item.received_ns)
            yield Step(item)
        elif item.record <= taken:
            if isinstance(item.event, IntegrationEvent):
                run.clouds.pop(item.event.input, None)
        else:
            run.record = item.record - 1
            yield Step(item, run.follow(item.event))


def _decode(item: InputRecord, settings: Settings) -> Content:
    try:
        return decode(item.kind, item.payload, settings)
    except ContractError as error:
        raise RunError(f"input {item.number} can't be read: {error}") from None
