"""Files that appear whole or not at all."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole(output: Path) -> Iterator[Path]:
    """Give the path to write to, in a hidden folder beside the output; what is there at the end takes its place.

    A file or folder of that name stays until then. After an error or Ctrl-C it is as it was, and nothing is left over.
    """
    with tempfile.TemporaryDirectory(dir=output.absolute().parent, prefix=".roughmap-") as room:
        inside = Path(room) / output.name
        yield inside
        for made in sorted(Path(room).iterdir(), key=lambda path: path == inside):  # what stands beside comes first
            place = output.with_name(made.name)
            if place.is_dir():
                shutil.rmtree(place)
            made.replace(place)
