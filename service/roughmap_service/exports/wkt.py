"""Coordinate reference systems as WKT."""

from roughmap_service.exports.sheet import ExportFault

ESRI = "WKT1_ESRI"
"""The form of .prj files."""

LAS = "WKT1_GDAL"
"""The form that the LAS specification means."""


def as_wkt(crs: str, form: str, what: str) -> str:
    """Return a coordinate reference system, WKT or EPSG:n, as WKT; ExportFault if that takes a library that is absent.

    WKT of any form is returned as it is.
    """
    if not crs.upper().startswith("EPSG:"):
        return crs
    try:
        from rasterio import Env  # noqa: PLC0415 - of an extra
        from rasterio.crs import CRS  # noqa: PLC0415 - of an extra
        from rasterio.errors import CRSError  # noqa: PLC0415
    except ImportError:
        raise ExportFault(
            f"{what} names {crs} by its WKT, which takes rasterio: pip install 'roughmap[geo]', or --crs WKT"
        ) from None
    try:
        with Env():  # keeps GDAL from writing to stderr by itself
            return str(CRS.from_user_input(crs).to_wkt(version=form))
    except CRSError as error:
        raise ExportFault(f"coordinate reference system {crs!r}: {error}") from None
