"""Whole files: an export is written to a folder beside its place, and moved there when it is complete."""

import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from roughmap_service.exports.sheet import ExportFault, Sheet


def write_whole(write: Callable[[Sheet, Path], None], sheet: Sheet, output: Path, *, replace: bool) -> None:
    """Write the output and the files that belong beside it, all or nothing.

    ExportFault if one of them exists, unless they may be replaced; a folder is replaced only by a bag, if it is one.
    """
    with tempfile.TemporaryDirectory(dir=output.absolute().parent, prefix=".export-") as room:
        staged = Path(room) / output.name
        try:
            write(sheet, staged)
        except ExportFault as fault:
            raise ExportFault(str(fault).replace(str(staged), str(output))) from None
        # The output comes last: it shows that all is there.
        made = sorted(Path(room).iterdir(), key=lambda path: path == staged)
        for path in made:
            _check(path, output.with_name(path.name), replace=replace)
        for path in made:
            target = output.with_name(path.name)
            if path.is_dir() and target.exists():
                shutil.rmtree(target)
            path.replace(target)


def _check(made: Path, target: Path, *, replace: bool) -> None:
    """Raise ExportFault if a file or folder can't be put in its place."""
    if not os.path.lexists(target):
        return
    if not replace:
        raise ExportFault(f"{target} exists and belongs to it; choose another name, or use --force to replace it")
    if made.is_dir() != target.is_dir() or (target.is_dir() and not (target / "metadata.yaml").is_file()):
        raise ExportFault(f"{target} is not a {'bag' if made.is_dir() else 'file'}, so it is not replaced")
    if target.is_dir() and target.is_symlink():
        raise ExportFault(f"{target} is a link to a folder, so it is not replaced")
