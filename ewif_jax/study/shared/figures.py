"""The look of all figures."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogFormatter

TRUTH, MEASURED = "#222222", "#9aa7b8"
EWIF, KALMAN, OTHER = "#1b7837", "#c51b7d", "#2166ac"


def study_canvas(
    rows: int = 1, columns: int = 1, *, width: float = 10, height: float = 4, **options: Any
) -> tuple[Figure, Any]:
    """A figure and its axes (an array unless there is one), with quiet grids and no frame lines."""
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(rows, columns, **options)
    for one in np.ravel(axes):
        one.grid(alpha=0.25, linewidth=0.6)
        one.spines[["top", "right"]].set_visible(False)
    return figure, axes


def label(axes: Axes, x: str, y: str, title: str = "") -> None:
    """Names of the axes, with units, and a title at the left."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_title(title, loc="left", fontsize="medium")


def plain_ticks(axes: Axes) -> None:
    """Writes the numbers of a logarithmic y axis as 20, not as 2 x 10^1."""
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
    axes.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.5, 0.4)))


def legend_in_a_row(axes: Axes) -> None:
    """A legend in one row above the axes, where it hides nothing."""
    place = {"loc": "lower left", "bbox_to_anchor": (0, 1), "borderaxespad": 0.2}
    axes.legend(frameon=False, fontsize="small", ncols=5, **place)
