"""The doctor on sensors that transforms mount: what is said of the transform, and of the points that it places."""

from typing import Any

import pytest
from doctor_traffic import NOW, SENSORS, Drive, configuration, findings, heard_transform

from roughmap_schemas import MapStatus
from roughmap_schemas.messages import CloudCounts
from roughmap_service.cli.doctor.clouds import judge_mounting
from roughmap_service.cli.doctor.findings import Finding
from roughmap_service.cli.doctor.service import knows_mountings

(FRAME,) = SENSORS


def by_transform(**more: Any) -> dict[str, Any]:
    return {"sensors": {FRAME: {"range_sigma": 0.02, "extrinsics": "transform", **more}}}


def heard(settings: dict[str, Any] | None, *transforms: Any) -> list[Finding]:
    return findings([*transforms, *Drive().messages()], settings)


def test_a_sensor_waits_for_its_transform() -> None:
    (found,) = [one for one in heard(by_transform()) if "waits for" in one.text]
    assert (found.verdict, found.area) == ("note", "r1")
    assert f"{FRAME!r} waits for the transform base -> {FRAME}" in found.text
    assert "no_extrinsics" in found.text
    assert "robots/r1/transform" in found.remedy


def test_nothing_else_is_wrong_with_it() -> None:
    """A mounting of zero is not one that was configured, and nothing is judged by it."""
    everywhere = [-1e3, -1e3, -1e3, 1e3, 1e3, 1e3]
    assert [one.text for one in heard(by_transform(exclude=[everywhere])) if one.verdict == "wrong"] == []


def test_a_transform_that_came_is_shown_and_judged_by() -> None:
    """It is used: nothing says that its parent is not the map's frame. The one that came last counts."""
    transforms = [
        heard_transform(0.1, 0, FRAME, "base_link", x=5.0),
        heard_transform(0.2, 0, FRAME, "base_link", x=100.0),
    ]
    found = heard(by_transform(exclude=[[50.0, -50.0, -50.0, 150.0, 50.0, 50.0]]), *transforms)
    texts = [one.text for one in found]
    assert f"mounting of {FRAME!r}: base_link -> {FRAME} at 100, 0, 0 m, by transform" in texts
    assert not [text for text in texts if "not used" in text or "waits for" in text]
    assert [one.verdict for one in found if "exclude" in one.text] == ["wrong"]


COUNTS = {"accepted": 5, "rejected": {"no_extrinsics": 2}}


@pytest.mark.parametrize(
    ("clouds", "instance", "known"),
    [
        ({"accepted": 9, "rejected": {"no_extrinsics": 2}}, "a", True),
        ({"accepted": 9, "rejected": {"no_extrinsics": 3}}, "a", False),
        ({"accepted": 5, "rejected": {"no_extrinsics": 2}}, "a", False),  # none was mapped: nothing is known
        ({"accepted": 9, "rejected": {"no_extrinsics": 2}}, "b", False),  # it was restarted
    ],
)
def test_a_service_may_know_the_mounting_from_before(clouds: dict[str, Any], instance: str, *, known: bool) -> None:
    def status(counts: dict[str, Any], run: str = "a") -> MapStatus:
        return MapStatus.model_construct(instance=run, clouds=CloudCounts.model_validate(counts))

    assert knows_mountings(status(COUNTS), status(clouds, instance)) is known
    assert not knows_mountings(None, status(clouds, instance))
    config = configuration(by_transform())
    (found,) = judge_mounting("r1", FRAME, config, None, mounted=known)
    assert found.verdict == ("ok" if known else "note")


def test_a_transform_that_mounts_nothing_is_told_as_before() -> None:
    found = heard(None, heard_transform(0.1, 0, FRAME, "base_link"))
    assert [one.verdict for one in found if "transforms from 'base_link' are not used" in one.text] == ["note"]


@pytest.mark.parametrize(("with_transform", "advice"), [(True, 'extrinsics = "transform"'), (False, "translation = ")])
def test_an_unknown_sensors_table_takes_the_mounting_from_where_it_is(with_transform: bool, advice: str) -> None:
    transforms = [heard_transform(0.1, NOW, FRAME, "base_link")] if with_transform else []
    found = findings([*transforms, *Drive().messages()], {"sensors": {"other": {"range_sigma": 0.02}}})
    (one,) = [one for one in found if one.settings.startswith("[sensors.") and "refused" in one.text]
    assert advice in one.settings
