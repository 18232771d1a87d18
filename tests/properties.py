"""Hypothesis profiles: `make test` tries the same examples each time, `make test-random` more and random ones."""

from hypothesis import HealthCheck, settings

SCALE = 10
"""How many times as many examples `make test-random` tries."""


def register() -> None:
    """Register the profiles and load ``ci``; `--hypothesis-profile=random` overrides that.

    Neither judges how fast examples are made: on a loaded machine that is a matter of chance.
    """
    slow = [HealthCheck.too_slow]
    settings.register_profile("ci", derandomize=True, deadline=None, print_blob=True, suppress_health_check=slow)
    settings.register_profile(
        "random", derandomize=False, deadline=None, print_blob=True, suppress_health_check=slow,
        max_examples=100 * SCALE,
    )  # fmt: skip
    settings.load_profile("ci")


def examples(number: int, *suppressed: HealthCheck) -> settings:
    """Settings of a property test: ``number`` examples, in the profile ``random`` ``SCALE`` times as many."""
    profile = settings.get_current_profile_name()
    return settings(
        max_examples=number * (SCALE if profile == "random" else 1),
        suppress_health_check=[HealthCheck.too_slow, *suppressed],
    )
