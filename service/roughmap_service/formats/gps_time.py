"""The times of points in LAS files as stamps.

Adjusted standard GPS time counts seconds from 10^9 s after 1980-01-06, without leap seconds; stamps count from 1970
with the clocks' leap seconds taken out, as robots do. Time of the GPS week counts from Sunday, and which week is not in
the file: such stamps count from the beginning of 1970, so that only their differences mean something.
"""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt

from roughmap_schemas.geometry import MAX_STAMP_S, SECOND_NS
from roughmap_service.formats.recorded import CloudFileFault, Floats

GPS_EPOCH_S = int(datetime(1980, 1, 6, tzinfo=UTC).timestamp())
ADJUSTMENT_S = 1_000_000_000
WEEK_S = 604_800

LEAPS = np.array([
    int(datetime(year, month, 1, tzinfo=UTC).timestamp()) - GPS_EPOCH_S + count
    for count, (year, month) in enumerate(
        (
            (1981, 7), (1982, 7), (1983, 7), (1985, 7), (1988, 1), (1990, 1), (1991, 1), (1992, 7), (1993, 7),
            (1994, 7), (1996, 1), (1997, 7), (1999, 1), (2006, 1), (2009, 1), (2012, 7), (2015, 7), (2017, 1),
        ),
        1,
    )
])  # fmt: skip
"""GPS seconds at which UTC has fallen one more second behind."""


def stamps_of(file: Path, times: Floats, *, adjusted: bool) -> npt.NDArray[np.int64]:
    """Return stamps in nanoseconds, (N,), of gps_time (N,) in seconds. Raises CloudFileFault."""
    if not len(times):
        return np.empty(0, np.int64)
    least, most = float(times.min()), float(times.max())
    low, high = (GPS_EPOCH_S + ADJUSTMENT_S, MAX_STAMP_S) if adjusted else (0, MAX_STAMP_S)
    last = high - low if adjusted else 2 * WEEK_S  # a drive over Saturday's midnight may count on
    first = -ADJUSTMENT_S if adjusted else 0
    if not (first <= least and most < last):
        kind = "adjusted standard GPS time" if adjusted else f"seconds of the GPS week, 0 to {WEEK_S}"
        raise CloudFileFault(
            f"{file}: expected gps_time as {kind} (the header says so), found {least:.15g} .. {most:.15g}; correct the "
            "header's global encoding, or leave out --scan-seconds"
        )
    whole = np.floor(times)
    nanoseconds = np.rint((times - whole) * SECOND_NS).astype(np.int64)
    seconds = whole.astype(np.int64)
    if adjusted:
        seconds += ADJUSTMENT_S
        seconds += GPS_EPOCH_S - np.searchsorted(LEAPS, seconds, side="right")
    return seconds * SECOND_NS + nanoseconds
