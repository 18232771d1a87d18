"""Columns of a text file of points by their names."""

import re
from collections.abc import Sequence

from roughmap_service.formats.text_words import LineFault, shown

NAMES = {
    "x": ("easting", "east", "e", "xcoord", "coordx", "xcoordinate", "pointx", "posx", "utmx", "utme"),
    "y": ("northing", "north", "n", "ycoord", "coordy", "ycoordinate", "pointy", "posy", "utmy", "utmn"),
    "z": (
        "elevation", "elev", "height", "altitude", "alt", "h", "up", "u", "zcoord", "coordz", "zcoordinate", "pointz",
        "posz", "utmz",
    ),
}  # fmt: skip
"""Other names of the columns x, y and z, as `plain` gives them."""

DEGREES = frozenset(("longitude", "lon", "long", "lng", "latitude", "lat"))
METRES = frozenset(("m", "metre", "metres", "meter", "meters"))

UNIT = re.compile(r"[\[(]([^\])]*)[\])]")


def plain(name: str) -> str:
    """Return the letters and digits of a name in lower case, without its unit: xcoord for `X_coord [m]`."""
    return re.sub(r"[^a-z0-9]", "", UNIT.sub("", name).lower())


def wanted_columns(number: int, names: Sequence[str]) -> tuple[int, int, int]:
    """Return the columns of x, y and z by the `names` in line `number`. Raises LineFault."""
    plains = [plain(name) for name in names]
    x, y, z = (_column(number, names, plains, axis) for axis in "xyz")
    return x, y, z


def _column(number: int, names: Sequence[str], plains: Sequence[str], axis: str) -> int:
    found = [k for k, name in enumerate(plains) if name == axis]
    found = found or [k for k, name in enumerate(plains) if name in NAMES[axis]]
    if not found and DEGREES & set(plains):
        raise LineFault(
            number, f"the coordinates are in degrees ({', '.join(names)}); project them to metres, for example to UTM"
        )
    if len(found) != 1:
        raise LineFault(
            number,
            f"expected a header with one column {axis} (or {NAMES[axis][0].capitalize()}), found "
            f"{shown(', '.join(names))}; rename the columns (or put # before a line that is no header)",
        )
    unit = UNIT.search(names[found[0]])
    if unit is not None and unit[1].strip().lower() not in METRES:
        raise LineFault(number, f"column {names[found[0]]!r} is not in metres; convert it")
    return found[0]
