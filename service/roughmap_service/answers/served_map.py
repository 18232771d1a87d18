"""The map that this process serves, as every answer and every status names it."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ServedMap:
    """One run of one map: its name, its run, the process that serves it, the digest of its settings, its frame."""

    map: str
    run: str
    instance: str
    configuration_digest: str
    frame_id: str
