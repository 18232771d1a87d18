"""Each role tries each key on a real router with the example's rules: what it may works, and nothing else does.

A denial is silent, so each attempt is followed by something allowed on the same link (`System.fence`), and then the
service is asked what came of it.
"""

from collections.abc import Callable, Iterator

import pytest
import zenoh
from access import ROLES, Certificates, System, running_system
from net import WAIT_S, Gathered

Attempt = Callable[[System, str], bool]
"""Tries something in a role; whether it worked."""

ROBOTS = frozenset({"rover1", "rover2"})
PLANNERS = frozenset({"planner", "operator"})
OPERATOR = frozenset({"operator"})
NOBODY: frozenset[str] = frozenset()

FOREIGN = "f" * 32
"""An instance that doesn't exist."""


@pytest.fixture(scope="module", params=["certificates", "passwords", "own"])
def system(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, certificates: Certificates
) -> Iterator[System]:
    with running_system(tmp_path_factory.mktemp(request.param), certificates.good, request.param) as system:
        yield system


def publishes(key: str, *, delete: bool = False) -> Attempt:
    """Whether the service logs, or counts as refused, what is put on a key."""

    def attempt(system: System, role: str) -> bool:
        before = system.settled()
        payload = system.cloud() if key.endswith("points") else system.pose()
        if delete:
            system.sessions[role].delete(key)
        else:
            system.sessions[role].put(key, payload)
        system.fence(role)
        after = system.settled()
        return (after.input, after.refused) != (before.input, before.refused)

    return attempt


def asks(key: str) -> Attempt:
    """Whether a request has an answer, or an effect without one."""

    def attempt(system: System, role: str) -> bool:
        before = system.settled()
        payload = {"odometry": system.pose(), "points": system.cloud()}.get(key.rpartition("/")[2])
        parameters = {"region": "?bbox=0,0,2,2", "cells": "?x=1;y=1"}.get(key.rpartition("/")[2], "")
        replies = list(system.sessions[role].get(key + parameters, payload=payload, timeout=WAIT_S))
        after = system.settled()
        if replies and replies[0].err is not None:
            assert (
                b"bad_message" in replies[0].err.payload.to_bytes()
            )  # a transform, which is none: the service says so
        return bool(replies) or (before.input, before.epoch) != (after.input, after.epoch)

    return attempt


def hears(key: str, told: str) -> Attempt:
    """Whether a subscriber to a key gets what the owner of the key `told` publishes there."""

    def attempt(system: System, role: str) -> bool:
        heard: Gathered[str] = Gathered()
        control: Gathered[str] = Gathered()
        other = "planner" if role == "operator" else "operator"
        with (
            system.sessions[role].declare_subscriber(
                key, lambda sample: heard(str(sample.key_expr)), allowed_origin=zenoh.Locality.REMOTE
            ),
            system.sessions[other].declare_subscriber(
                "maps/site/events", lambda sample: control(str(sample.key_expr)), allowed_origin=zenoh.Locality.REMOTE
            ),
        ):
            system.fence(role)
            system.fence(other)
            system.sessions["rover2"].put("robots/rover2/points", system.cloud())
            control.wait(lambda items: len(items) > 0, "the event of a cloud")
            if told.startswith("maps/site/events") or "robots/" in told:
                system.fence(role)  # it was sent before the control was
            elif role in PLANNERS:
                heard.wait(lambda items: told in items, f"{told}, which comes when it is due")
            else:
                # What comes when it is due is waited for where it is allowed, then it was sent here too.
                with system.sessions["planner"].declare_subscriber(told, lambda s: control(str(s.key_expr))):
                    system.fence("planner")
                    system.sessions["rover2"].put("robots/rover2/points", system.cloud())
                    control.wait(lambda items: told in items, told)
                system.fence(role)
            return told in heard.items

    return attempt


def poses_as_service(key: str) -> Attempt:
    """Whether a planner hears a sample that a role forges."""

    def attempt(system: System, role: str) -> bool:
        witness = "operator" if role == "planner" else "planner"
        heard: Gathered[bytes] = Gathered()
        with system.sessions[witness].declare_subscriber(key, lambda sample: heard(sample.payload.to_bytes())):
            system.fence(witness)
            system.sessions[role].put(key, b"forged")
            system.fence(role)
            system.fence(witness)
            return b"forged" in heard.items

    return attempt


def answers_as_service(system: System, role: str) -> bool:
    """Whether a planner's question reaches a queryable of a role."""
    asked: Gathered[str] = Gathered()
    asker = system.clients["operator" if role == "planner" else "planner"]
    with system.sessions[role].declare_queryable(
        "maps/site/region", lambda query: asked(str(query.key_expr)), complete=True
    ):
        system.fence(role)
        asker.region((0, 0, 2, 2))
        system.fence(role)
        return bool(asked.items)


def commands_as_service(system: System, role: str) -> bool:
    """Whether an operator's command reaches a queryable of a role, which would say that it is done."""
    asked: Gathered[str] = Gathered()
    key = "maps/site/control/snapshot"
    with system.sessions[role].declare_queryable(key, lambda query: asked(str(query.key_expr)), complete=True):
        system.fence(role)
        with system.another("operator") as operator:
            assert list(operator.get(key, target=zenoh.QueryTarget.ALL, timeout=WAIT_S))
        system.fence(role)
        return bool(asked.items)


def lives_as_service(system: System, role: str) -> bool:
    """Whether a role can keep a service from starting, by a token of an instance that isn't."""
    other = "operator" if role == "planner" else "planner"
    with system.sessions[role].liveliness().declare_token(f"maps/site/alive/{FOREIGN}"):
        system.fence(role)
        return any(FOREIGN in key for key in alive(system, other))


def sees_the_service_alive(system: System, role: str) -> bool:
    return len(alive(system, role)) == 1


def alive(system: System, role: str) -> list[str]:
    replies = system.sessions[role].liveliness().get("maps/site/alive/*", timeout=WAIT_S)
    return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]


def own(robot: str) -> frozenset[str]:
    return frozenset({robot})


CASES: dict[str, tuple[Attempt, frozenset[str]]] = {
    **{
        f"put {robot} {kind}": (publishes(f"robots/{robot}/{kind}"), own(robot))
        for robot in sorted(ROBOTS)
        for kind in ("points", "odometry", "transform")
    },
    **{
        f"put {key}": (publishes(key), NOBODY)
        for key in ("robots/*/points", "robots/**", "robots/rover$*/points", "robots/rover1/*", "robots/rover3/points")
    },
    "delete rover1": (publishes("robots/rover1/points", delete=True), NOBODY),
    **{
        f"ingest {robot} {kind}": (asks(f"maps/site/ingest/{robot}/{kind}"), own(robot))
        for robot in sorted(ROBOTS)
        for kind in ("points", "odometry", "transform")
    },
    **{
        f"query {key}": (asks(key), NOBODY)
        for key in (
            "maps/site/ingest/*/points",
            "maps/*/ingest/**",
            "maps/site/ingest/rover$*/odometry",
            "maps/site/**",
            "**",
            "maps/site/*",
            "maps/site/*/reset",
            "maps/site/control/*",
            "maps/site/queries",
        )
    },
    **{
        f"query {key}": (asks(key), PLANNERS)
        for key in ("maps/site/tiles/0/*/*", "maps/site/region", "maps/site/cells", "maps/site/status")
    },
    "snapshot": (asks("maps/site/control/snapshot"), OPERATOR),
    "forget": (asks("maps/site/control/forget?bbox=500,500,501,501"), OPERATOR),
    "reset": (asks("maps/site/control/reset"), OPERATOR),
    "hear events": (hears("maps/site/events", "maps/site/events"), PLANNERS),
    "hear updates": (hears("maps/site/updates/*/*/*", "maps/site/updates/0/0/0"), PLANNERS),
    "hear status": (hears("maps/site/status", "maps/site/status"), PLANNERS),
    "hear other robots": (hears("robots/*/points", "robots/rover2/points"), NOBODY),
    "hear all": (hears("**", "maps/site/events"), NOBODY),
    **{
        f"forge {key}": (poses_as_service(key), NOBODY)
        for key in ("maps/site/events", "maps/site/status", "maps/site/updates/0/0/0")
    },
    "answer in its place": (answers_as_service, NOBODY),
    "be commanded in its place": (commands_as_service, NOBODY),
    "live in its place": (lives_as_service, NOBODY),
    "see it alive": (sees_the_service_alive, PLANNERS),
}


@pytest.mark.parametrize("role", ROLES)
def test_a_role_tries_each_key(system: System, role: str) -> None:
    wrong = []
    for case, (attempt, allowed) in CASES.items():
        try:
            worked = attempt(system, role)
        except Exception as error:
            error.add_note(f"while {role} tried: {case}")
            raise
        if worked is not (role in allowed):
            wrong.append(f"{role}: {case}: {'works, and must not' if worked else 'does not work, and must'}")
    assert not wrong, "\n".join(wrong)
