"""What stands on the ground or hangs over it: boxes, upright cylinders and ellipsoids, and where a beam meets them.

Leaves and grass let a part of a beam's way through, glass a part of the beams.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from roughmap.jit import inline

BOX, CYLINDER, ELLIPSOID = 0, 1, 2

SOLID = np.dtype(
    [
        ("shape", "i8"),
        ("x", "f8"),
        ("y", "f8"),
        ("z", "f8"),
        ("half_x", "f8"),
        ("half_y", "f8"),
        ("half_z", "f8"),
        ("density", "f8"),
        ("share", "f8"),
        ("soft", "i8"),
    ]
)
"""One solid: centre and half sizes in metres, its axes the map's. `density` is the mean number of hits per metre
inside, inf if opaque; `share` the part of the beams that come back at all; `soft` is 1 for what a robot drives through.
"""

GOLDEN = 0.618033988749895

Solids = npt.NDArray[np.void]
Floats = npt.NDArray[np.float64]


def solid(
    shape: int,
    centre: tuple[float, float, float],
    half: tuple[float, float, float],
    *,
    density: float = np.inf,
    share: float = 1.0,
    soft: bool = False,
) -> Solids:
    """Return one solid, (1,)."""
    return np.array([(shape, *centre, *half, density, share, soft)], dtype=SOLID)


def extent(solids: Solids, index: int, dx: Floats, dy: Floats) -> tuple[Floats, Floats]:
    """Return the lowest and highest z of a solid at horizontal offsets from its centre; NaN beside it."""
    one = solids[index]
    u, v = dx / one["half_x"], dy / one["half_y"]
    if one["shape"] == BOX:
        half = np.where((np.abs(u) <= 1) & (np.abs(v) <= 1), one["half_z"], np.nan)
    else:
        inside = 1 - u * u - v * v
        upright = one["half_z"] if one["shape"] == CYLINDER else one["half_z"] * np.sqrt(np.maximum(inside, 0))
        half = np.where(inside >= 0, upright, np.nan)
    return one["z"] - half, one["z"] + half


@inline
def reach(one: Any) -> float:
    """Return the radius of the upright cylinder around a solid."""
    if one.shape == BOX:
        return float(np.hypot(one.half_x, one.half_y))
    return float(max(one.half_x, one.half_y))


@inline
def meet(one: Any, x: float, y: float, z: float, dx: float, dy: float, dz: float, chance: float) -> float:
    """Return the range at which a beam hits the solid, inf if it does not.

    The direction is a unit vector; `chance`, uniform in [0, 1), decides for glass and leaves.
    """
    if chance >= one.share:
        return np.inf
    # Seen with the half sizes as units, a solid is a cube, a cylinder or a sphere of size 1; ranges stay as they are.
    ox, oy, oz = (x - one.x) / one.half_x, (y - one.y) / one.half_y, (z - one.z) / one.half_z
    ux, uy, uz = dx / one.half_x, dy / one.half_y, dz / one.half_z
    enter, leave = 0.0, np.inf
    if one.shape == BOX:
        enter, leave = _slab(ox, ux, enter, leave)
        enter, leave = _slab(oy, uy, enter, leave)
        enter, leave = _slab(oz, uz, enter, leave)
    elif one.shape == CYLINDER:
        enter, leave = _ball(ux * ux + uy * uy, ox * ux + oy * uy, ox * ox + oy * oy - 1.0, enter, leave)
        enter, leave = _slab(oz, uz, enter, leave)
    else:
        square = ux * ux + uy * uy + uz * uz
        enter, leave = _ball(square, ox * ux + oy * uy + oz * uz, ox * ox + oy * oy + oz * oz - 1.0, enter, leave)
    if enter >= leave:
        return np.inf
    if one.density < np.inf:
        enter -= np.log(1.0 - chance) / one.density  # the way to the first leaf is exponential
    return enter if enter < leave else np.inf


@inline
def _slab(offset: float, slope: float, enter: float, leave: float) -> tuple[float, float]:
    """Return the part of the way from `enter` to `leave` where |offset + t slope| <= 1."""
    if slope == 0.0:
        return (enter, leave) if abs(offset) <= 1.0 else (enter, enter)
    one, other = (-1.0 - offset) / slope, (1.0 - offset) / slope
    return max(enter, min(one, other)), min(leave, max(one, other))


@inline
def _ball(square: float, half: float, rest: float, enter: float, leave: float) -> tuple[float, float]:
    """Return the part of the way where square t^2 + 2 half t + rest <= 0."""
    under = half * half - square * rest
    if under <= 0.0 or square == 0.0:  # an upright beam inside a cylinder: no scanner here has one
        return enter, enter
    root = np.sqrt(under)
    return max(enter, (-half - root) / square), min(leave, (-half + root) / square)
