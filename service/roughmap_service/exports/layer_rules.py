"""Which layers a format can hold: told before a map is opened, and kept by the writers."""

from roughmap_service.exports.sheet import ExportFault

HEIGHT = "mean_height"

PASSABLE = "traversability"


def only_layer(layers: tuple[str, ...], what: str) -> str:
    """Return the only layer; ExportFault if there are several. ``what`` names the format, as in "a PNG"."""
    if len(layers) != 1:
        raise ExportFault(
            f"{what} holds one layer, not {', '.join(layers)}: write one file for each, or all in one .tif or .npz"
        )
    return layers[0]


def height_first(layers: tuple[str, ...]) -> None:
    """Raise ExportFault unless mean_height comes first: it becomes the points' z."""
    if layers[0] != HEIGHT:
        names = ",".join([HEIGHT, *(name for name in layers if name != HEIGHT)])
        raise ExportFault(f"points need their height as the first layer: --layers {names}")


def passable_alone(layers: tuple[str, ...]) -> None:
    """Raise ExportFault for a map for Nav2 of anything but traversability."""
    if layers != (PASSABLE,):
        raise ExportFault(f"a map for Nav2 shows {PASSABLE} alone: leave out --layers")
