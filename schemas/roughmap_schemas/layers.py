"""The names of what a cell says, as they stand in keys, selectors and grids."""

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
"""Every layer. The map core has the same tuple: repeated here so that a client need not load the kernels."""

DEFAULT_LAYERS = ("mean_height",)
"""What a query that names no layers gets."""

LIMIT_NAMES = ("slope", "step", "std_dev", "range", "confidence")
"""What traversability may be limited by."""
