"""The coordinate reference system that a recording states."""

from pathlib import Path

from roughmap_service.formats.las_header import MAX_CRS_BYTES, read_header, unit_of
from roughmap_service.formats.recorded import CloudFileFault


def crs_of(path: Path) -> str | None:
    """Return the coordinate reference system of a recording: WKT, or EPSG:n where the file has no more; None if none.

    LAS and LAZ files state it themselves. Beside any other file NAME.xyz it may stand as WKT in NAME.prj, as GIS
    programs write it. Raises CloudFileFault and OSError.
    """
    if path.suffix.lower() in {".las", ".laz"}:
        with path.open("rb") as stream:
            return read_header(path, stream).crs
    beside = path.with_suffix(".prj")
    if path.is_dir() or not beside.is_file():
        return None
    with beside.open("rb") as stream:
        text = stream.read(MAX_CRS_BYTES + 1)
    if len(text) > MAX_CRS_BYTES or b"\0" in text:
        raise CloudFileFault(f"{beside}: expected the WKT of a coordinate reference system, found something else")
    wkt = text.decode("utf-8", "replace").strip()
    if unit := unit_of(wkt):
        raise CloudFileFault(f"{beside}: the coordinate reference system is in {unit}; the map takes metres: reproject")
    return wkt or None
