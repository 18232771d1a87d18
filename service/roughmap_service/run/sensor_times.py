"""The times of the points of each sensor: in which form they are, as found in its first clouds or configured."""

from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass, field
from typing import Any, Self

from roughmap_schemas import NO_TIMES, Cloud, SensorConfig, TimeForm, contract_timed, timed
from roughmap_service.run.point_times import NAMES, Ambiguous, find_form, misfit
from roughmap_service.run.settings import Settings, time_offset_ns

MISFITS = 5
"""Clouds in a row whose times have another form, after which the form is found anew."""

Sensor = tuple[str, str]
"""A robot and a frame."""


Setting = tuple[str, str, str]
"""A sensor's time_field, time_unit and time_origin."""


@dataclass(frozen=True, slots=True)
class Reading:
    """How the times of a cloud's points are read: in this form, ``offset_ns`` added. Without a form as in
    `contract_timed`: in the map's frame and in old logs."""

    form: TimeForm | None = None
    offset_ns: int = 0

    def apply(self, cloud: Cloud) -> Cloud:
        """Return the cloud with its points' times."""
        return contract_timed(cloud) if self.form is None else timed(cloud, self.form, self.offset_ns)

    def to_state(self) -> list[Any]:
        """Return it as JSON values."""
        return [None if self.form is None else astuple(self.form), self.offset_ns]

    @classmethod
    def of_state(cls, state: Sequence[Any]) -> Self:
        """Restore what `to_state` returned."""
        form, offset_ns = state
        return cls(None if form is None else TimeForm(*form), offset_ns)


BY_CONTRACT = Reading()


@dataclass
class SensorTimes:
    """The forms found so far, each with the settings that it was found under, and for each the number of clouds in a
    row that did not fit it. A form does not count under other settings."""

    forms: dict[Sensor, tuple[TimeForm, Setting]] = field(default_factory=dict)
    misfits: dict[Sensor, int] = field(default_factory=dict)

    def reading(self, robot: str, cloud: Cloud, settings: Settings) -> Reading | None:
        """Return how the times of the cloud's points are read; None if their form is not known."""
        config = _config(robot, cloud.frame_id, settings)
        if config is None:
            return BY_CONTRACT
        form = self._form((robot, cloud.frame_id), config)
        timeless = config.time_field == "auto" and not any(one.name in NAMES for one in cloud.time_fields)
        if form is None and (timeless or config.time_field == "none"):
            form = NO_TIMES
        return None if form is None else Reading(form, time_offset_ns(config))

    def count(self, robot: str, cloud: Cloud, settings: Settings) -> None:
        """Count a new cloud that does not fit the form found; after `MISFITS` in a row, forget the form."""
        sensor = robot, cloud.frame_id
        config = _config(robot, cloud.frame_id, settings)
        form = None if config is None else self._form(sensor, config)
        if form is None or not misfit(cloud, form):
            self.misfits.pop(sensor, None)
            return
        self.misfits[sensor] = self.misfits.get(sensor, 0) + 1
        if self.misfits[sensor] >= MISFITS:
            del self.forms[sensor], self.misfits[sensor]

    def take(self, sensor: Sensor, form: TimeForm, settings: Settings) -> None:
        """Read the sensor's times in this form from now on."""
        config = _config(*sensor, settings)
        self.forms[sensor] = form, ("", "", "") if config is None else _setting(config)

    def find(
        self, sensor: Sensor, clouds: Iterable[Cloud], settings: Settings, *, last: bool
    ) -> TimeForm | Ambiguous | None:
        """Look for the form in a sensor's waiting clouds; None if more of them are needed, which ``last`` rules out."""
        config = _config(*sensor, settings)
        if config is None:
            return NO_TIMES
        fields = [(cloud.stamp_ns, cloud.time_fields) for cloud in clouds]
        return find_form(fields, config.time_field, config.time_unit, config.time_origin, last=last)

    def to_state(self) -> list[Any]:
        """Return everything as JSON values."""
        return [
            [*sensor, astuple(form), setting, self.misfits.get(sensor, 0)]
            for sensor, (form, setting) in self.forms.items()
        ]

    def load_state(self, state: Iterable[Any]) -> None:
        """Restore what `to_state` returned."""
        for robot, frame_id, form, (name, unit, origin), misfits in state:
            self.forms[robot, frame_id] = TimeForm(*form), (name, unit, origin)
            if misfits:
                self.misfits[robot, frame_id] = misfits

    def _form(self, sensor: Sensor, config: SensorConfig) -> TimeForm | None:
        form, setting = self.forms.get(sensor, (None, None))
        return form if setting == _setting(config) else None


def _config(robot: str, frame_id: str, settings: Settings) -> SensorConfig | None:
    """Return the sensor's settings; None where times have the contract's form: in the map's frame, and in old logs."""
    if settings.rules == 1 or frame_id == settings.frame_id:
        return None
    return settings.config.sensor(robot, frame_id)


def _setting(config: SensorConfig) -> Setting:
    return config.time_field, config.time_unit, config.time_origin
