"""The names of layers and limits, as selectors and grids write them."""

LAYERS = (
    "mean_height",
    "mid_range_height",
    "max_height",
    "min_height",
    "std_dev",
    "range",
    "confidence_level",
    "confidence_factor",
    "mean_variance",
    "count",
    "weight",
    "expected_count",
    "age",
    "gradient_x",
    "gradient_y",
    "slope",
    "step_height",
    "traversability",
)
"""Every layer. ``roughmap.reading.layers`` has the same tuple; it is repeated here so that a client need not load the
kernels."""

DEFAULT_LAYERS = ("mean_height",)
"""The layers of a query that names none."""

LIMIT_NAMES = ("slope", "step", "std_dev", "range", "confidence")
"""The quantities that ``traversability`` may limit."""
