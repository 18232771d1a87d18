"""Recorded stamps: what is in another unit than its array's name says, or too coarse."""

import numpy as np
import numpy.typing as npt

Stamps = npt.NDArray[np.generic]

UNITS = {"stamp_s": 1, "stamp_ns": 1_000_000_000}
"""Parts of a second that an array's stamps count."""

LAST_S = 2**32

NAMES = {1: "seconds", 1_000: "milliseconds", 1_000_000: "microseconds", 1_000_000_000: "nanoseconds"}

PLAUSIBLE_S = (0.9e9, LAST_S)
"""Seconds since the epoch that recordings have: 1998 to 2106."""

LEAST_PERIOD_NS = 200_000
"""Scans, or the packets of one, come no faster than this on average."""

MOST_STEP_S = 0.01


def stamps_fault(name: str, stamps: Stamps) -> str | None:
    """Return what is wrong with the stamps of scans, (K,) and finite, in the array `name`; None if nothing is."""
    if not stamps.size:
        return None
    fault = outside(name, stamps)
    if fault is not None:
        return fault
    if name == "stamp_s":
        # A float32 of seconds since the epoch has steps of two minutes.
        step = float(np.spacing(np.abs(stamps).max())) if stamps.dtype.kind == "f" else 0.0
        if step > MOST_STEP_S:
            return f"stamp_s is {stamps.dtype}, whose steps are {step:g} s here; save it as float64"
        return None
    values = stamps.astype(np.float64)
    period = (values.max() - values.min()) / max(len(values) - 1, 1)
    unit = _likely_unit(float(values.max()))
    if unit not in {None, UNITS[name]} and 0 < period < LEAST_PERIOD_NS:
        return f"stamp_ns looks like {NAMES[unit or 1]} ({int(values.max())}); expected nanoseconds; convert them"
    return None


def outside(name: str, stamps: Stamps) -> str | None:
    """Return what is wrong with stamps outside of [0, 2^32) seconds; None if none is."""
    if not stamps.size:
        return None
    least, most = float(stamps.min()), float(stamps.max())
    if least >= 0 and most < LAST_S * UNITS[name]:
        return None
    unit = _likely_unit(most)
    expected = f"expected {NAMES[UNITS[name]]} since the epoch, 0 to 2^32 s"
    if least >= 0 and unit not in {None, UNITS[name]}:
        remedy = "; name it stamp_ns" if unit == UNITS["stamp_ns"] else "; convert them"
        return f"{name} looks like {NAMES[unit or 1]} ({int(most)}); {expected}{remedy}"
    return f"{expected} in {name}, found {stamps.min()} .. {stamps.max()}"


def _likely_unit(value: float) -> int | None:
    """Return the parts of a second in which `value` is a time since the epoch that recordings have."""
    return next((unit for unit in NAMES if PLAUSIBLE_S[0] <= value / unit < PLAUSIBLE_S[1]), None)
