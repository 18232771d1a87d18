"""Bags of ROS: rosbag2 folders and their single files (.mcap, .db3; zstd too), and ROS 1 bags (.bag).

A folder whose files are packed as a whole (compression_mode FILE) is unpacked to the folder for temporary files first.
"""

from collections.abc import Iterator
from pathlib import Path

from roughmap_service.formats.bag_files import open_bag
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.posed_clouds import messages_of
from roughmap_service.formats.recorded import Recorded


def read_bag(path: Path, options: ReadOptions) -> Iterator[Recorded]:
    """Return a robot's messages in the order in which they were recorded. Raises CloudFileFault and OSError."""
    with open_bag(path) as bag:
        yield from messages_of(bag, options)
