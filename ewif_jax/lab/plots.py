"""Pictures of filters and data. Each draws on `ax` (default: the axes of a new figure), and returns
the axes; `.figure.savefig(...)` saves them.

What is true is black, what was measured grey; other roles keep their colour and mark everywhere,
and are told apart in grey too.
"""

from ewif_jax.lab.pictures_of_filters import (
    arrivals,
    calibrated_factor,
    component,
    consistency,
    innovations,
    track,
)
from ewif_jax.lab.pictures_of_tuning import history, landscape, merit_map

__all__ = [
    "arrivals",
    "calibrated_factor",
    "component",
    "consistency",
    "history",
    "innovations",
    "landscape",
    "merit_map",
    "track",
]
