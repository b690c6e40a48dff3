"""The look of all pictures: one role, one colour; told apart in grey by dashes and marks."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from ewif_jax.types import Numbers

TRUTH, MEASURED, ESTIMATE, BAND = "#000000", "#8c96a0", "#0072b2", "#56b4e9"
"""What is true is black in every picture."""

# Okabe and Ito's colours, which are told apart by the colour-blind, from dark to light.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")
DASHES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1, 1.2)), (0, (6, 2, 1, 2)), (0, (3, 1.5)))
MARKS = ("o", "s", "^", "D", "v", "P", "X")
STATUS = {
    "used": ("#8c96a0", ".", "used"),
    "late_used": ("#d55e00", "^", "late, used"),
    "too_late": ("#cc79a7", "x", "too late"),
    "rejected": ("#009e73", "s", "rejected"),
    "masked": ("#bbbbbb", "+", "nothing measured"),
}


class Look(NamedTuple):
    """How a line is drawn."""

    color: str
    linestyle: Any
    marker: str


def looks(names: Sequence[str]) -> dict[str, Look]:
    """A look for each name, by its place."""
    return {
        name: Look(COLOURS[k % len(COLOURS)], DASHES[k % len(DASHES)], MARKS[k % len(MARKS)])
        for k, name in enumerate(names)
    }


def canvas(
    rows: int = 1, columns: int = 1, *, width: float = 8, height: float = 4.5, **options: Any
):
    """A figure and its axes (R, C), with quiet grids and no frame lines."""
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for each in axes.ravel():
        quiet(each)
    return figure, axes


def own_axes(ax: Axes | None, width: float = 7.0, height: float = 4.5) -> Axes:
    """`ax`, or the axes of a new figure."""
    if ax is not None:
        return ax
    return canvas(width=width, height=height)[1][0, 0]


def quiet(ax: Axes) -> None:
    """A quiet grid and no frame lines."""
    ax.grid(alpha=0.25, linewidth=0.6)
    ax.spines[["top", "right"]].set_visible(False)


def label(ax: Axes, x: str, y: str, title: str = "") -> None:
    """Names of the axes, and a title at the left."""
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    if title:
        ax.set_title(title, loc="left", fontsize="medium")


def plain_log_ticks(ax: Axes) -> None:
    """Ticks 1, 2, 5, 10, ... of a logarithmic x axis, written without powers of ten where they are
    of middling size."""
    ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())


def legend_above(ax: Axes, columns: int = 4) -> None:
    """A legend above the axes, where it hides nothing."""
    place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0, 1), "borderaxespad": 0.3}
    ax.legend(frameon=False, fontsize="small", ncols=columns, **place)


def robust_limits(
    ax: Axes, values: Numbers, *, floor: float | None = None, factor: float = 3.0
) -> None:
    """Limits of the y axis that a few outliers do not blow up: the middle 95 % of `values`, and
    `factor` times as much to each side where values lie there. What is outside is marked by
    triangles at the edge, with their number."""
    value = np.asarray(values, float).ravel()
    value = value[np.isfinite(value)]
    if value.size < 2:
        return
    low, high = np.percentile(value, [2.5, 97.5])
    reach = factor * max(high - low, 1e-12 * max(abs(high), 1.0))
    bottom, top = max(value.min(), low - reach), min(value.max(), high + reach)
    margin = 0.05 * (top - bottom or 1.0)
    bottom = bottom - margin if floor is None else max(bottom - margin, floor)
    ax.set_ylim(bottom, top + margin)
    above, below = int((value > top).sum()), int((value < bottom).sum())
    text = " ".join(f"{mark} {n} beyond" for mark, n in (("▲", above), ("▼", below)) if n)
    if text:
        place: dict[str, Any] = {
            "xycoords": "axes fraction",
            "ha": "right",
            "va": "top",
            "fontsize": "small",
        }
        ax.annotate(text, (0.99, 0.99), color="#555555", **place)


def clipped(ax: Axes, x: Numbers, y: Numbers, color: str) -> None:
    """Triangles at the edge of the axes, where points lie outside of its limits."""
    bottom, top = ax.get_ylim()
    x, y = np.asarray(x, float), np.asarray(y, float)
    for mark, edge, is_out in (("^", top, y > top), ("v", bottom, y < bottom)):
        if is_out.any():
            where = np.full(is_out.sum(), edge)
            ax.plot(x[is_out], where, mark, color=color, markersize=4, clip_on=False)
