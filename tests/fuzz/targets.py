"""All targets by name; each takes any bytes and raises only over a finding."""

from collections.abc import Callable
from pathlib import Path

import file_targets
import ros_targets
import wire_targets

CORPUS = Path(__file__).parent / "corpus"
"""CORPUS/TARGET/FILE: inputs to begin with, and every one that was a finding (found-...)."""

TARGETS: dict[str, Callable[[bytes], None]] = {
    function.__name__: function
    for function in (
        wire_targets.cloud,
        wire_targets.odometry,
        wire_targets.transform,
        wire_targets.grid,
        wire_targets.selectors,
        wire_targets.cells,
        wire_targets.keys,
        wire_targets.events,
        wire_targets.replies,
        file_targets.configuration,
        file_targets.log,
        file_targets.blob,
        file_targets.store,
        file_targets.stored,
        file_targets.clouds_npz,
        file_targets.clouds_text,
        file_targets.clouds_ply,
        file_targets.clouds_pcd,
        file_targets.clouds_las,
        ros_targets.ros_names,
        ros_targets.ros_messages,
        ros_targets.ros_feed,
    )
}

MAX_BYTES = 16384
"""Of an input: more makes runs slower, and finds no more."""


def corpus_of(target: str) -> list[Path]:
    return sorted((CORPUS / target).iterdir())
