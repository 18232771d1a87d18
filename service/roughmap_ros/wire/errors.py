"""Errors of Zenoh as errors with a known cause."""

from collections.abc import Iterator
from contextlib import contextmanager

import zenoh

from roughmap_client.errors import short_message
from roughmap_schemas.faults import ReportedError


class WireError(ReportedError):
    """Zenoh refused to declare or send something; one line with the topic and the cause."""


@contextmanager
def zenoh_errors(topic: str) -> Iterator[None]:
    """Raise WireError for Zenoh's errors."""
    try:
        yield
    except zenoh.ZError as error:
        if "timestamping" in str(error):
            raise WireError(
                f"{topic}: a publisher with best_effort transient_local needs timestamps in the Zenoh session; found "
                "them off; set timestamping.enabled to true in its configuration"
            ) from None
        raise WireError(f"{topic}: Zenoh: {short_message(error)}") from None
