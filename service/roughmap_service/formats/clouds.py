"""Read recordings from any file format that has a reader."""

from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import cast

from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import CloudFileFault, Recorded

READERS: Mapping[str, str] = {
    **dict.fromkeys((".asc", ".csv", ".txt", ".xyz"), "text.read_text"),
    **dict.fromkeys((".bag", ".db3"), "bags.read_bag"),
    **dict.fromkeys((".las", ".laz"), "las.read_las"),
    ".mcap": "mcaps.read_mcap",
    ".npz": "npz.read_npz",
    ".pcd": "pcd.read_pcd",
    ".ply": "ply.read_ply",
}
"""The reader of each suffix: module of this folder and function, imported when first needed. A new format is a module
with a reader, and a line here."""

FOLDERS: Mapping[str, str] = {"metadata.yaml": "bags.read_bag", "velodyne": "kitti.read_kitti"}
"""The reader of a folder that holds a file or folder of that name; the first that is found."""

CLOUD_SUFFIXES = frozenset((".npz", ".pcd", ".ply", ".xyz"))
"""Files with one cloud each, which a folder of scans may hold; `cloud_folder` reads it."""

Reader = Callable[[Path, ReadOptions], Iterator[Recorded]]


def read_cloud(path: Path, options: ReadOptions | None = None) -> Iterator[Recorded]:
    """Return the parts of a recording in order. Raises CloudFileFault, or OSError if it can't be opened."""
    return reader_of(path)(path, options or ReadOptions())


def reader_of(path: Path) -> Reader:
    """Return the reader of a file by its suffix, or of a folder by what it holds; CloudFileFault if there is none."""
    if path.is_dir():
        found = next((reader for name, reader in FOLDERS.items() if (path / name).exists()), None)
        if found is None and any(file.suffix.lower() in CLOUD_SUFFIXES for file in path.iterdir()):
            found = "cloud_folder.read_cloud_folder"
        if found is None:
            holds = ", ".join(sorted((*FOLDERS, *CLOUD_SUFFIXES)))
            raise CloudFileFault(f"{path}: not a recording; expected a folder with one of {holds} in it, or a file")
    elif path.exists() and not path.is_file():
        raise CloudFileFault(f"{path}: not a recording; expected a file or a folder, found a pipe or a device")
    else:
        suffix = path.suffix.lower()
        found = READERS.get(suffix)
        if found is None:
            allowed = ", ".join(sorted(READERS))
            raise CloudFileFault(f"{path}: unknown file format {suffix or '(no suffix)'!r} (allowed: {allowed})")
    module, function = found.split(".")
    return cast("Reader", getattr(import_module(f"roughmap_service.formats.{module}"), function))
