"""The times of the points of each sensor: in which form they are, as found in its first clouds or configured."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from roughmap_schemas import NO_TIMES, Cloud, SensorConfig, TimeForm, contract_timed, timed
from roughmap_service.run.point_times import NAMES, Ambiguous, find_form, misfit
from roughmap_service.run.settings import NS, Settings

MISFITS = 5
"""Clouds in a row whose times have another form, after which the form is found anew."""

Sensor = tuple[str, str]
"""A robot and a frame."""


@dataclass
class SensorTimes:
    """The forms found so far, and for each the number of clouds in a row that did not fit it."""

    forms: dict[Sensor, TimeForm] = field(default_factory=dict)
    misfits: dict[Sensor, int] = field(default_factory=dict)

    def read(self, robot: str, cloud: Cloud, settings: Settings) -> Cloud | None:
        """Return the cloud with its points' times, `sensors.*.time_offset` added; None if their form is not known."""
        config = _config(robot, cloud.frame_id, settings)
        if config is None:
            return contract_timed(cloud)
        form = self.forms.get((robot, cloud.frame_id))
        timeless = config.time_field == "auto" and not any(one.name in NAMES for one in cloud.time_fields)
        if form is None and (timeless or config.time_field == "none"):
            form = NO_TIMES
        return None if form is None else timed(cloud, form, round(config.time_offset * NS))

    def count(self, robot: str, cloud: Cloud, settings: Settings) -> None:
        """Count a new cloud that does not fit the form found; after `MISFITS` in a row, forget the form."""
        sensor = robot, cloud.frame_id
        config, form = _config(robot, cloud.frame_id, settings), self.forms.get(sensor)
        if config is None or form is None or not misfit(cloud, form):
            self.misfits.pop(sensor, None)
            return
        self.misfits[sensor] = self.misfits.get(sensor, 0) + 1
        if self.misfits[sensor] >= MISFITS:
            del self.forms[sensor], self.misfits[sensor]

    def find(
        self, sensor: Sensor, clouds: Iterable[Cloud], settings: Settings, *, last: bool
    ) -> TimeForm | Ambiguous | None:
        """Look for the form in a sensor's waiting clouds; None if more of them are needed, which ``last`` rules out."""
        config = _config(*sensor, settings)
        if config is None:
            return NO_TIMES
        fields = [(cloud.stamp_ns, cloud.time_fields) for cloud in clouds]
        return find_form(fields, config.time_field, config.time_unit, config.time_origin, last=last)

    def forget_changed(self, before: Settings, after: Settings) -> None:
        """Forget the forms of sensors whose settings of times changed."""
        for sensor in [s for s in self.forms if _time_settings(s, before) != _time_settings(s, after)]:
            del self.forms[sensor]
            self.misfits.pop(sensor, None)

    def to_state(self) -> list[Any]:
        """Return everything as JSON values."""
        return [
            [*sensor, form.field, form.unit, form.origin, self.misfits.get(sensor, 0)]
            for sensor, form in self.forms.items()
        ]

    def load_state(self, state: Iterable[Any]) -> None:
        """Restore what `to_state` returned."""
        for robot, frame_id, name, unit, origin, misfits in state:
            self.forms[robot, frame_id] = TimeForm(name, unit, origin)
            if misfits:
                self.misfits[robot, frame_id] = misfits


def _config(robot: str, frame_id: str, settings: Settings) -> SensorConfig | None:
    """Return the sensor's settings; None where times have the contract's form: in the map's frame, and in old logs."""
    if settings.rules == 1 or frame_id == settings.frame_id:
        return None
    return settings.config.sensor(robot, frame_id)


def _time_settings(sensor: Sensor, settings: Settings) -> Mapping[str, Any] | None:
    config = _config(*sensor, settings)
    return None if config is None else config.model_dump(include={"time_field", "time_unit", "time_origin"})
