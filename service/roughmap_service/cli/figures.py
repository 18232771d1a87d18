"""Numbers as people copy them: in full, never 5.94911e+06."""


def metres(value: float) -> str:
    """Return a length or coordinate to the micrometre, without the zeros at its end: `5949113.6`."""
    text = f"{value:.6f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def statistic(value: float) -> str:
    """Return a value of a layer with four digits, or to the thousandth if it has more before the point."""
    return metres(round(value, 3)) if 10 <= abs(value) < 1e15 else f"{value:.4g}"
