"""The map that this process serves, as every answer and every status names it."""

from dataclasses import dataclass

from roughmap_schemas.layers import Surface


@dataclass(frozen=True, slots=True)
class ServedMap:
    """One run of one map: its name, its run, the process that serves it, the digest of its settings, frame, surface."""

    map: str
    run: str
    instance: str
    configuration_digest: str
    frame_id: str
    surface: Surface
